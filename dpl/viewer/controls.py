"""Panel of the page: controls, and readings as HTML. All text is escaped."""

import html
import math
from pathlib import Path

import numpy as np
import torch
from matplotlib.ticker import EngFormatter
from numpy.typing import ArrayLike
from torch import Tensor
from viser import ViserServer

from dpl.fem import ModalLoads
from dpl.inference.answer import LEAST_PERCENTAGE, UNKNOWN, UNRELIABLE, relative
from dpl.viewer.frames import QUANTITIES, Body, Frame, ViewSettings
from dpl.viewer.recording import RADIUS, SUFFIXES
from dpl.viewer.renderer import band_colours, engineering

GOOD, WARNING, BAD = "#15803d", "#b45309", "#b91c1c"
GOOD_ERROR = 0.01  # estimated error below which it is green [-]
ROW = (
    '<div style="display:flex;justify-content:space-between;gap:12px;line-height:1.65">'
    '<span style="opacity:.62">{}</span>'
    '<span style="font-variant-numeric:tabular-nums;text-align:right;{}">{}</span></div>'
)
BOLD = "font-weight:600"
BOX = '<div style="padding:2px 12px 6px;font-size:13.5px">{}</div>'
LABELS = {"poisson": "Poisson's ratio"}  # of parameters
PREDICTION, BUDGET = "prediction", "best within the budget"
PULL, GRASP = "pull", "grasp"
ABOUT = {
    PULL: "Drag the body to pull it. Click it to place the loaded patch.",
    GRASP: "Drag the body to move a patch of it as a rigid body. Click it to grasp another patch.",
}
RADII = {PULL: RADIUS, GRASP: 0.15}  # of the patch over L, at first [-]
AXES = {"x": 0, "y": 1, "z": 2}
METHODS = {PREDICTION: None, **{f"residual below {tol:.0e}": tol for tol in (1e-3, 1e-6, 1e-8)}}
METHODS[BUDGET] = 1e-8  # relative residuals


class Controls:
    """Widgets of the panel.

    Attributes:
        radii: Sliders of the radius of the patch over L, by mode; `radius` is the selected value.
        young: Slider of Young's modulus, in a unit with prefix; `modulus` is its value in Pa.
        parameters: Sliders of the ranges of law and follower loads, by name.
        readings, details: HTML of the result; `state` is that of the recording.
        of_load, of_moduli, of_settings: The widgets that change load or grasp, moduli or settings.
        follows_frame: True while the page, a drag or a random load determines the load, so that the
            slider shows the amplitude of the frame.
    """

    def __init__(self, server: ViserServer, body: Body, title: str, folder: Path) -> None:
        """Add the widgets to the panel; those that few users need are in closed folders."""
        gui, scene = server.gui, body.scene
        self._gui, self._body, self.follows_frame = gui, body, True
        law = type(scene.problem.material).__name__
        size = math.prod(scene.problem.shape)
        gui.add_html(message(f"{title} · {size:,} degrees of freedom · {law}", "inherit"))
        self.readings = gui.add_html("")
        self._about = gui.add_html("")
        self.mode = gui.add_dropdown("drag", (PULL, GRASP))
        self.axis = gui.add_dropdown("rotation axis", tuple(AXES), initial_value="y")
        self.angle = gui.add_slider("rotation [°]", -90.0, 90.0, 1.0, 0.0, marks=(-90, 0, 90))
        units = scene.problem.follower_loads.units.items()
        labels = {name: f"{name} [{unit}]" for name, unit in units} | LABELS
        self.parameters = {
            name: gui.add_slider(
                labels.get(name, name), *ends, round_step(*ends), body.parameters[name]
            )
            for name, ends in scene.loads.parameter_ranges.items()
        }
        self.quantity = gui.add_dropdown("colours", tuple(QUANTITIES))
        self.sample = gui.add_button("Random training load")
        self.reset = gui.add_button("Reset", color="gray")
        with gui.add_folder("Details of the result", expand_by_default=False):
            self.details = gui.add_html("")
        with gui.add_folder("Load", expand_by_default=False):
            self._add_load_controls()
        with gui.add_folder("Method and view", expand_by_default=False):
            self.method = gui.add_dropdown("method", tuple(METHODS))
            self.budget = gui.add_number("budget [ms]", 20.0, min=0.1, max=10_000.0)
            self.edges = gui.add_checkbox("mesh edges", False)
            self.show_newton = gui.add_checkbox("compare Newton", False)
            self.fit = gui.add_button("Fit the view", color="gray")
        with gui.add_folder("Record", expand_by_default=False):
            self.record = gui.add_button("Start recording", color="red")
            self.state = gui.add_html(message(f"Files are saved in {folder}", "inherit"))
            self.save = gui.add_button_group("save as", tuple(SUFFIXES))
        of_patch = (*self.radii.values(), self.axis, self.angle, self.sliding)
        self.of_load = (self.direction, self.amplitude, *of_patch)
        self.of_moduli = (self.young, *self.parameters.values())
        shown = (self.quantity, self.edges, self.show_newton)
        self.of_settings = (self.method, self.budget, *shown)
        self.show_mode()

    def _add_load_controls(self) -> None:
        gui, body, loads = self._gui, self._body, self._body.scene.loads
        span = loads.patch_radius if isinstance(loads, ModalLoads) else (0.0, 1.0)
        low, high = float(span[0]), max(float(span[1]), 0.05)
        first = {PULL: min(max(RADII[PULL], low), high), GRASP: min(RADII[GRASP], high)}
        self.radii = {
            mode: gui.add_slider("radius / L", 0.0, high, 0.01, first[mode]) for mode in RADII
        }
        upwards = (0.0, 1.0, 0.0) if body.surface.planar else (0.0, 0.0, 1.0)
        self.direction = gui.add_vector3("direction", upwards, step=0.1)
        self.amplitude = gui.add_slider("amplitude", -2.0, 2.0, 0.01, 0.0, marks=(-1, 0, 1))
        hint = "hold the patch along its normal alone, so that it slides in its plane"
        self.sliding = gui.add_checkbox("sliding", False, hint=hint)
        exponent = 3 * math.floor(math.log10(body.young) / 3)
        self._young_unit = 10.0**exponent
        low, high, middle = (x / self._young_unit for x in (*body.young_range, body.young))
        name = f"E [{EngFormatter.ENG_PREFIXES[exponent]}Pa]"
        self.young = gui.add_slider(name, low, high, round_step(low, high), middle)

    def show_mode(self) -> None:
        """Show the controls of the selected mode."""
        mode = self.mode.value
        self._about.content = message(ABOUT[mode], "inherit")
        for of_mode, radius in self.radii.items():
            radius.visible = of_mode == mode
        self.direction.visible = self.amplitude.visible = mode == PULL
        self.angle.visible = self.sliding.visible = mode == GRASP
        self.axis.visible = mode == GRASP and not self._body.surface.planar

    @property
    def radius(self) -> float:
        """Radius of the patch over L [-]."""
        return float(self.radii[self.mode.value].value)

    @property
    def rotation(self) -> Tensor:
        """Rotation vector of the patch, (3,), in 2D the angle, (1,) [rad]."""
        angle = torch.tensor([self.angle.value]).double().deg2rad()
        if self._body.surface.planar:
            return angle
        return angle * torch.eye(3, dtype=torch.float64)[AXES[self.axis.value]]

    @property
    def modulus(self) -> float:
        """Young's modulus of the slider [Pa]; an assigned value is limited to its range."""
        return float(np.clip(self.young.value * self._young_unit, *self._body.young_range))

    @modulus.setter
    def modulus(self, value: float) -> None:
        self.young.value = float(np.clip(value, *self._body.young_range)) / self._young_unit

    def settings(self) -> ViewSettings:
        """Return method and quantity."""
        budget = self.budget.value if self.method.value == BUDGET else None
        tol, show_newton = METHODS[self.method.value], bool(self.show_newton.value)
        return ViewSettings(self.quantity.value, tol, budget, show_newton)

    def show_frame(self, frame: Frame, top: float, node: int, below: str) -> None:
        """Update readings, details and, with `follows_frame`, the amplitude.

        `top` is the upper end of the colours, 0 without a legend. The displacement is that of
        `node`. `below` is HTML below the legend.
        """
        scene = self._body.scene
        amplitude = frame.request.amplitude(frame.answer, scene)
        result, details = result_tables(frame, node, amplitude)
        self.readings.content = result + (legend(frame, top) if top > 0 else "") + below
        self.details.content = details
        if self.follows_frame:
            self.amplitude.value = round(min(amplitude, float(self.amplitude.max)), 2)


def result_tables(frame: Frame, node: int, amplitude: float) -> tuple[str, str]:
    """Return the tables of a result of the simulator and of its details, see `show_frame`.

    `amplitude` is the size of the load over the largest of the training.
    """
    grasp, answer = frame.grasp, frame.answer
    error, outside = float(answer.error), answer.out_of_distribution
    colour = GOOD if error < GOOD_ERROR else WARNING if error < UNRELIABLE else BAD
    text = "above 100 %" if error >= UNKNOWN else relative(error)
    text = f"below {relative(LEAST_PERCENTAGE)}" if error < LEAST_PERCENTAGE else text
    unit = ("N", "N m") if frame.displacement.shape[1] == 3 else ("N/m", "N")
    place = "outside" if outside else "unknown" if np.isnan(answer.out_of_span) else "inside"
    span = ("training range", f"{place}, amplitude {amplitude:.2f}", f"color:{BAD}" * outside)
    forces = [("total force", _size(frame.load.force.sum(dim=0), unit[0]), BOLD)]
    warnings, others = [span] * outside, [span]
    if grasp is not None:  # the forces of a good grasp may be outside
        forces = [
            ("force of the gripper", _size(grasp.force, unit[0]), BOLD),
            ("moment of the gripper", _size(grasp.moment, unit[1]), BOLD),
        ]
        warnings, others = [], [span, ("motion error", engineering(grasp.motion_error, "m"), "")]
    rows = [
        ("estimated error", text, f"color:{colour};{BOLD}"),
        *forces,
        ("displacement at the hand", _size(frame.displacement[node], "m"), BOLD),
        ("time", f"{answer.milliseconds:.1f} ms", ""),
        *warnings,
    ]
    details = [
        ("computed by", str(answer.method), ""),
        ("linear solves" if grasp is None else "iterations", f"{answer.iterations}", ""),
        ("residual ‖R‖/‖f‖", f"{answer.residual:.1e}" if answer.residual else "0", ""),
        ("min det F", f"{answer.volume_ratio:.3f}", ""),
        *others,
    ]
    summary = f'<div style="line-height:1.35">{html.escape(answer.summary)}</div>'
    return table(*rows), table(*details, below=summary)


def _size(vector: ArrayLike, unit: str) -> str:
    return engineering(float(np.linalg.norm(np.asarray(vector))), unit)


def table(*rows: tuple[str, str, str], above: str = "", below: str = "") -> str:
    """Return a table of rows (name, value and style of the value) between other HTML."""
    lines = [ROW.format(html.escape(name), look, html.escape(text)) for name, text, look in rows]
    return BOX.format("".join([above, *lines, below]))


def problem_of(frame: Frame, *, has_budget: bool = False) -> str:
    """Return why a frame cannot be used, in one line; empty if it can."""
    if not frame.answer.volume_ratio > 0:
        return "Not valid: an element is inverted. Move the hand back."
    if (grasp := frame.grasp) is None:
        return ""
    if grasp.stopped and not has_budget:  # a budget is the time that the user has chosen
        return (
            f"Not solved: stopped after {grasp.milliseconds / 1e3:.1f} s with an estimated error "
            f"of {relative(grasp.error)}. Move the hand back."
        )
    if grasp.error < UNRELIABLE:
        return ""
    apart = engineering(grasp.motion_error, "m")
    return (
        f"Not reliable: estimated error {relative(grasp.error)}, the patch is {apart} away from "
        "the hand. Move the hand back, or select a residual as method."
    )


def newton_table(frame: Frame | None) -> str:
    """Return state, iteration and residual of an iterate of Newton; None before the first."""
    if frame is None:
        return table(("Newton from zero", "starts when the load is constant", ""))
    state, residual = frame.answer, float(frame.answer.residual)
    colour, words = (GOOD, "converged") if state.converged else (WARNING, "iterating")
    return table(
        ("Newton from zero", words, f"color:{colour};{BOLD}"),
        ("iteration", str(int(state.iterations)), ""),
        ("residual ‖R‖/‖f‖", f"{residual:.1e}", f"color:{colour}"),
    )


def legend(frame: Frame, top: float) -> str:
    """Return the colour bar, which ends at `top`, and the range of the values on the surface."""
    unit = QUANTITIES[frame.quantity]
    finite = frame.values[np.isfinite(frame.values)]
    low, high = (finite.min(), finite.max()) if len(finite) else (0.0, 0.0)
    cells = "".join(
        f'<span style="flex:1;background:rgb({r},{g},{b})"></span>'
        for r, g, b in band_colours(frame.quantity).tolist()
    )
    ticks = "".join(f"<span>{engineering(top * k / 4, unit)}</span>" for k in range(5))
    span = f"{engineering(low, unit)} to {engineering(high, unit)}"
    return table(("on the surface", span, ""), above=(
        f'<div style="margin-bottom:4px"><b>{html.escape(frame.quantity)}</b></div>'
        f'<div style="display:flex;height:14px;border-radius:3px;overflow:hidden">{cells}</div>'
        f'<div style="display:flex;justify-content:space-between;font-size:11.5px;opacity:.75">'
        f"{ticks}</div>"
    ))  # fmt: skip


def message(text: str, colour: str = WARNING) -> str:
    """Return a line of text."""
    style = f"padding:2px 12px 6px;font-size:13px;color:{colour};line-height:1.35"
    return f'<div style="{style}">{html.escape(text)}</div>' if text else ""


def round_step(low: float, high: float, *, steps: int = 200) -> float:
    """Return a power of ten that divides an interval into at least `steps` steps.

    The step is at least 1e-4 of the largest power of ten in it, so that values have at most five
    digits. Equal ends, as of a fixed value, count as an interval from zero.
    """
    step = 10.0 ** math.floor(math.log10((high - low or abs(high)) / steps))
    return max(step, 10.0 ** (math.floor(math.log10(max(abs(low), abs(high)))) - 4))

"""Panel of the page: controls, and readings as HTML. All text is escaped."""

import html
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from viser import ViserServer

from dpl.fem import HasModes
from dpl.inference import GraspAnswer
from dpl.inference.answer import UNRELIABLE, relative
from dpl.viewer.frames import QUANTITIES, TOLERANCES, Body, Frame, ViewSettings
from dpl.viewer.recording import MAX_FRAMES, SUFFIXES, Recording
from dpl.viewer.renderer import N_BANDS, band_colours
from dpl.viewer.units import engineering, round_step, scaled, unit_for, unit_of_scale

GOOD, WARNING, BAD = "#15803d", "#b45309", "#b91c1c"
ROW = (
    '<div style="display:flex;justify-content:space-between;gap:12px;line-height:1.65">'
    '<span style="opacity:.62">{}</span>'
    '<span style="font-variant-numeric:tabular-nums;text-align:right;{}">{}</span></div>'
)
BOX = '<div style="padding:2px 12px 6px;font-size:13.5px">{}</div>'
LABELS = {"poisson": "Poisson's ratio"}  # of parameters
NETWORK, BUDGET = "network", "best within the budget"
PULL, GRASP = "pull", "grasp"
ABOUT = {
    PULL: "Drag the body to pull it. Click it to place the loaded patch.",
    GRASP: "Drag the body to move a patch of it as a rigid body. Click it to grasp another patch.",
}
RADIUS = {PULL: 0.4, GRASP: 0.15}  # of the patch over L, at first [-]
AXES = {"x": 0, "y": 1, "z": 2}
METHODS = {NETWORK: None, **{f"residual below {tol:.0e}": tol for tol in TOLERANCES}}


class Controls:
    """Widgets of the

    Attributes:
        mode: Mode of a drag, `PULL` or `GRASP`.
        radius: Radius of the patch over L; each mode has its own.
        direction, amplitude, unlimited, uniform: The patch load, visible in the mode `PULL`.
        axis, angle, sliding: Rotation of the patch and whether it slides, visible in the mode
            `GRASP`; in 2D there is no axis.
        young: Slider of Young's modulus, in a unit with prefix; `modulus` is its value in Pa.
        parameters: Sliders of the ranges of law and follower loads, by name.
        sample, reset, fit: Buttons for a random load, for no load and for the camera.
        method, budget, galerkin, quantity, edges, show_newton: Method and display.
        record, save: Buttons of the recording.
        of_load, of_moduli, of_settings: The widgets that change load or grasp, moduli or settings.
        follows_frame: True while a drag or a random load determines the load, so that the slider
            shows the amplitude of the frame.
    """

    def __init__(self, server: ViserServer, body: Body, title: str, folder: Path) -> None:
        """Add the widgets to the"""
        gui, scene = server.gui, body.scene
        self._gui, self._body = gui, body
        nodes, dim = scene.problem.shape
        law = type(scene.problem.material).__name__
        about = f"{title} · {nodes * dim:,} degrees of freedom · {law}"
        gui.add_html(message(about, "inherit"))
        self._result, self._legend = gui.add_html(""), gui.add_html("")
        self._newton = gui.add_html("", visible=False)
        self._error = gui.add_html("")
        with gui.add_folder("Load"):
            self._add_load_controls()
        with gui.add_folder("Method and colours"):
            self._add_method_controls()
        with gui.add_folder("Record", expand_by_default=False):
            self.record = gui.add_button("Start recording", color="red")
            self._state = gui.add_html(message(f"Files are saved in {folder}", "inherit"))
            self.save = gui.add_button_group("save as", tuple(SUFFIXES))
        self.follows_frame = False
        of_patch = (self.radius, self.axis, self.angle, self.sliding)
        self.of_load = (self.direction, self.amplitude, self.uniform, *of_patch)
        self.of_moduli = (self.young, *self.parameters.values())
        shown = (self.quantity, self.edges, self.show_newton)
        self.of_settings = (self.method, self.budget, self.galerkin, *shown)

    def _add_load_controls(self) -> None:
        gui, body, loads = self._gui, self._body, self._body.scene.loads
        self.mode = gui.add_dropdown("drag", (PULL, GRASP))
        self._about = gui.add_html("")
        span = loads.patch_radius if isinstance(loads, HasModes) else (0.0, 1.0)
        low, high = float(span[0]), max(float(span[1]), 0.05)
        first = min(max(RADIUS[PULL], low), high)
        self._radii = {PULL: first, GRASP: min(RADIUS[GRASP], high)}
        self.radius = gui.add_slider("radius / L", 0.0, high, 0.01, first)
        upwards = (0.0, 1.0, 0.0) if body.scene.problem.shape[1] == 2 else (0.0, 0.0, 1.0)
        self.direction = gui.add_vector3("direction", upwards, step=0.1)
        self.amplitude = gui.add_slider("amplitude", -2.0, 2.0, 0.01, 0.0, marks=(-1, 0, 1))
        self.axis = gui.add_dropdown("rotation axis", tuple(AXES), initial_value="y")
        self.angle = gui.add_slider("rotation [°]", -90.0, 90.0, 1.0, 0.0, marks=(-90, 0, 90))
        hint = "hold the patch along its normal alone, so that it slides in its plane"
        self.sliding = gui.add_checkbox("sliding", False, hint=hint)
        self._young_unit = unit_for(body.young, "Pa")
        low, high = (value / self._young_unit.factor for value in body.young_range)
        label, middle = f"E [{self._young_unit.name}]", body.young / self._young_unit.factor
        self.young = gui.add_slider(label, low, high, round_step(low, high), middle)
        stresses = {name: f"{name} [Pa]" for name in body.scene.problem.follower_loads.ranges}
        labels = LABELS | stresses
        self.parameters = {
            name: gui.add_slider(labels.get(name, name), *ends, round_step(*ends), value)
            for (name, ends), value in zip(
                loads.parameter_ranges.items(), body.parameters.values(), strict=True
            )
        }
        hint = "let a drag exceed the largest load of the training"
        self.unlimited = gui.add_checkbox("no limit", False, hint=hint)
        hint = "equal forces on all nodes of the patch, outside the training range"
        self.uniform = gui.add_checkbox("uniform force", False, hint=hint)
        self.sample = gui.add_button("Random training load")
        self.reset = gui.add_button("Reset", color="gray")
        self._shown_mode = PULL
        self.show_mode()

    def _add_method_controls(self) -> None:
        gui, galerkin = self._gui, self._body.has_galerkin
        self.method = gui.add_dropdown("method", (*METHODS, BUDGET))
        self.budget = gui.add_number("budget [ms]", 20.0, min=0.1, max=10_000.0)
        hint = "correct the prediction in the modes of the network before Newton"
        self.galerkin = gui.add_checkbox(
            "Galerkin correction", galerkin, visible=galerkin, hint=hint
        )
        self.quantity = gui.add_dropdown("colours", tuple(QUANTITIES))
        self.edges = gui.add_checkbox("mesh edges", False)
        self.show_newton = gui.add_checkbox("compare Newton", False)
        self.fit = gui.add_button("Fit the view", color="gray")

    def show_mode(self) -> None:
        """Show the controls of the selected mode, with the last radius of this mode."""
        mode = self.mode.value
        self._about.content = message(ABOUT[mode], "inherit")
        self._radii[self._shown_mode] = self.radius.value
        self.radius.value, self._shown_mode = self._radii[mode], mode
        for control in (self.direction, self.amplitude, self.unlimited, self.uniform):
            control.visible = mode == PULL
        self.angle.visible = self.sliding.visible = mode == GRASP
        self.axis.visible = mode == GRASP and self._body.scene.problem.shape[1] == 3

    @property
    def rotation(self) -> Tensor:
        """Rotation vector of the patch, (3,), in 2D the angle, (1,) [rad]."""
        angle = torch.tensor([self.angle.value]).double().deg2rad()
        if self._body.scene.problem.shape[1] == 2:
            return angle
        return angle * torch.eye(3, dtype=torch.float64)[AXES[self.axis.value]]

    @property
    def modulus(self) -> float:
        """Young's modulus of the slider [Pa]; an assigned value is limited to its range."""
        value = self.young.value * self._young_unit.factor
        return float(np.clip(value, *self._body.young_range))

    @modulus.setter
    def modulus(self, value: float) -> None:
        within = float(np.clip(value, *self._body.young_range))
        self.young.value = within / self._young_unit.factor

    def settings(self) -> ViewSettings:
        """Return method and quantity.

        Raises:
            ValueError: A value is out of range.
        """
        within_budget = self.method.value == BUDGET
        return ViewSettings(
            self.quantity.value,
            TOLERANCES[-1] if within_budget else METHODS.get(self.method.value),
            self.budget.value if within_budget else None,
            bool(self.galerkin.value) and self._body.has_galerkin,
            bool(self.show_newton.value),
        )

    def show_frame(self, frame: Frame, top: float, frame_rate: float, node: int) -> None:
        """Update result, legend and, if a drag determined the load, the amplitude.

        `node` is the node whose displacement is shown.
        """
        self._result.content = result_table(frame, frame_rate, node)
        self._legend.content = legend(frame, top)
        if self.follows_frame and frame.answer is not None:
            limit = float(self.amplitude.max)
            self.amplitude.value = round(min(float(frame.answer.amplitude), limit), 2)

    def show_newton_frame(self, frame: Frame | None, visible: bool) -> None:
        """Update the table of Newton, or hide it."""
        self._newton.content, self._newton.visible = newton_table(frame), visible

    def show_error(self, text: str) -> None:
        """Show why a request cannot be solved; an empty text removes the message."""
        self._error.content = message(text, BAD)

    def show_progress(self, seconds: float) -> None:
        """Show for how long the solve in progress has taken [s]."""
        self._error.content = message(f"Solving for {seconds:.0f} s ...")

    def show_recording(self, recording: Recording) -> None:
        """Update the label of the record button."""
        running, count = recording.running, len(recording)
        stop = f"Stop ({count} of {MAX_FRAMES} frames)"
        self.record.label = stop if running else "Start recording"
        if running:
            self.show_state(f"{count} frames", "inherit")

    def show_state(self, text: str, colour: str = WARNING) -> None:
        """Show a message below the record button."""
        self._state.content = message(text, colour)


def result_table(frame: Frame, frame_rate: float, node: int) -> str:
    """Return forces, method, time, residual, range check and summary of a result of the simulator.

    `node` is the node whose displacement is shown, the centre of the patch.
    """
    answer = frame.answer
    assert answer is not None
    colour = GOOD if frame.converged else WARNING if frame.volume_ratio > 0 else BAD
    outside = answer.out_of_distribution
    place = "outside" if outside else "unknown" if np.isnan(answer.out_of_span) else "inside"
    is_told = frame.grasp is None or outside  # the forces of a good grasp may have any place
    span = f"{place}, amplitude {answer.amplitude:.2f}"
    rows = [
        *(_load_rows(frame) if frame.grasp is None else _gripper_rows(frame, frame.grasp)),
        _row("displacement at the hand", _length(frame.displacement[node]), "font-weight:600"),
        _row("computed by", str(answer.method), "font-weight:600"),
        _row("time", f"{answer.milliseconds:.1f} ms, {frame_rate:.0f} fps"),
        _row("estimated error", relative(float(answer.error)), f"color:{colour}"),
        _row(
            "residual ‖R‖/‖f‖",
            f"{frame.residual:.1e}" if frame.residual else "0",
            f"color:{colour}",
        ),
        _row("min det F", f"{frame.volume_ratio:.3f}"),
        _row("linear solves" if frame.grasp is None else "iterations", f"{answer.iterations}"),
        *([_row("training range", span, f"color:{BAD if outside else GOOD}")] if is_told else []),
        f'<div style="margin-top:6px;padding:6px 9px;border-radius:6px;border-left:3px solid '
        f'{colour};background:{colour}14;line-height:1.35">{html.escape(answer.summary)}</div>',
    ]
    return BOX.format("".join(rows))


def _load_rows(frame: Frame) -> list[str]:
    """Return the total force of a load."""
    return [_row("total force", _force(frame.load.force.sum(dim=0)), "font-weight:600")]


def _gripper_rows(frame: Frame, grasp: GraspAnswer) -> list[str]:
    """Return force and moment of the gripper, and the distance of the patch from the hand."""
    moment = float(np.linalg.norm(grasp.moment))
    unit = "N m" if len(grasp.moment) == 3 else "N"
    return [
        _row("force of the gripper", _force(grasp.force), "font-weight:600"),
        _row("moment of the gripper", engineering(moment, unit), "font-weight:600"),
        _row("motion error", engineering(grasp.motion_error, "m")),
    ]


def _force(force: ArrayLike) -> str:
    """Return the size of a force (D,) [N]."""
    components = np.asarray(force)
    unit = "N" if len(components) == 3 else "N/m"
    return engineering(float(np.linalg.norm(components)), unit)


def _length(vector: ArrayLike) -> str:
    """Return the length of a vector [m]."""
    return engineering(float(np.linalg.norm(np.asarray(vector))), "m")


def problem_of(frame: Frame, *, has_budget: bool = False) -> str:
    """Return why a frame cannot be used, in one line; empty if it can.

    With a budget the user has chosen the time after which a grasp stops, so that this is no reason.
    """
    if not frame.volume_ratio > 0:
        return "Not valid: an element is inverted. Move the hand back."
    grasp = frame.grasp
    if grasp is not None and grasp.stopped and not has_budget:
        return (
            f"Not solved: stopped after {grasp.milliseconds / 1e3:.1f} s with an estimated error "
            f"of {relative(grasp.error)}. Move the hand back."
        )
    if grasp is None or grasp.error < UNRELIABLE:
        return ""
    apart = engineering(grasp.motion_error, "m")
    return (
        f"Not reliable: estimated error {relative(grasp.error)}, the patch is {apart} away from "
        "the hand. Move the hand back, or select a residual as method."
    )


def newton_table(frame: Frame | None) -> str:
    """Return state, iteration and residual of an iterate of Newton; None before the first."""
    if frame is None:
        return BOX.format(_row("Newton from zero", "starts when the load is constant"))
    colour, state = (GOOD, "converged") if frame.converged else (WARNING, "iterating")
    rows = [
        _row("Newton from zero", state, f"color:{colour};font-weight:600"),
        _row("iteration", str(frame.iteration)),
        _row("residual ‖R‖/‖f‖", f"{frame.residual:.1e}", f"color:{colour}"),
    ]
    return BOX.format("".join(rows))


def legend(frame: Frame, top: float) -> str:
    """Return the colour bar, which ends at `top`, and the range of the values on the surface.

    The result is empty if the bar would end at 0: all values are zero and the body is neutral.
    """
    if top <= 0:
        return ""
    quantity, unit = frame.quantity, unit_of_scale(top, QUANTITIES[frame.quantity])
    finite = frame.values[np.isfinite(frame.values)]
    low, high = (finite.min(), finite.max()) if len(finite) else (0.0, 0.0)
    cells = "".join(
        f'<span style="flex:1;background:rgb({r},{g},{b})"></span>'
        for r, g, b in band_colours(quantity).tolist()
    )
    ticks = "".join(f"<span>{scaled(top * k / 4, unit.factor)}</span>" for k in range(5))
    span = f"{scaled(low, unit.factor)} to {scaled(high, unit.factor)} {unit.name}"
    return BOX.format(
        f'<div style="display:flex;justify-content:space-between;margin-bottom:4px">'
        f"<b>{html.escape(f'{quantity} [{unit.name}]')}</b>"
        f'<span style="opacity:.62">{N_BANDS} bands</span></div>'
        f'<div style="display:flex;height:14px;border-radius:3px;overflow:hidden">{cells}</div>'
        f'<div style="display:flex;justify-content:space-between;font-size:11.5px;opacity:.75">'
        f"{ticks}</div>" + _row("on the surface", span)
    )


def message(text: str, colour: str = WARNING) -> str:
    """Return a line of text."""
    style = f"padding:2px 12px 6px;font-size:13px;color:{colour};line-height:1.35"
    return f'<div style="{style}">{html.escape(text)}</div>' if text else ""


def _row(name: str, value: str, style: str = "") -> str:
    return ROW.format(html.escape(name), style, html.escape(value))

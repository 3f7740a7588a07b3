"""HTML of the readings on the page. All text is escaped."""

import html

import numpy as np
from numpy.typing import ArrayLike

from dpl.inference import GraspAnswer
from dpl.inference.answer import UNRELIABLE, relative
from dpl.viewer.frames import QUANTITIES, Frame
from dpl.viewer.renderer import N_BANDS, band_colours
from dpl.viewer.units import engineering, scaled, unit_of_scale

GOOD, WARNING, BAD = "#15803d", "#b45309", "#b91c1c"
ROW = (
    '<div style="display:flex;justify-content:space-between;gap:12px;line-height:1.65">'
    '<span style="opacity:.62">{}</span>'
    '<span style="font-variant-numeric:tabular-nums;text-align:right;{}">{}</span></div>'
)
BOX = '<div style="padding:2px 12px 6px;font-size:13.5px">{}</div>'


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

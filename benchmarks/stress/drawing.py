"""Figures of load sweeps: min det F, residual and error of a surrogate against the load."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.stress.case import LoadLevel
from benchmarks.verification.drawing import MARKS, panel, picture
from dpl.visualization import COLOURS

LABELS = {
    "volume_ratio": "smallest min det F [-]",
    "residual": "final ||R|| / ||f|| [-]",
    "error": "relative error against Newton [-]",
}


def draw(levels: Sequence[LoadLevel], path: Path) -> None:
    """Draw load sweeps, one panel for min det F and one for the residual.

    A third panel shows the errors where there are any. The training range is shaded. A cross marks
    a load without a solution.

    Args:
        levels: Loads of all sweeps.
        path: Image file.
    """
    wanted = ["volume_ratio", "residual"]
    if any(level.error > 0 for level in levels):
        wanted.append("error")
    names = list(dict.fromkeys(level.series for level in levels))
    with picture(path, 3.4 + 0.16 * math.ceil(len(names) / 3)) as figure:
        for place, quantity in enumerate(wanted, 1):
            title = f"({'abc'[place - 1]})"
            ax = panel(
                figure, place, "load / range [-]", LABELS[quantity], title, columns=len(wanted)
            )
            ax.set(xscale="log", yscale="log")
            ax.axvspan(min(level.amplitude for level in levels), 1.0, color="0.95", zorder=0)
            for k, name in enumerate(names):
                _draw_series(ax, [r for r in levels if r.series == name], quantity, k)
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)


def _draw_series(ax: Any, levels: Sequence[LoadLevel], quantity: str, k: int) -> None:
    """Draw one sweep; crosses mark loads without a solution."""
    colour = COLOURS[k % len(COLOURS)]
    style = {"marker": MARKS[k // len(COLOURS) % len(MARKS)], "markersize": 2.8, "linewidth": 0.8}
    several = len({level.amplitude for level in levels}) < len(levels)
    points = [(r.amplitude, getattr(r, quantity)) for r in levels]
    drawn = [(x, y) for x, y in points if y > 0]  # the axes are logarithmic
    ax.plot(
        *([x for x, _ in drawn], [y for _, y in drawn]),
        **{**style, "color": colour, "label": levels[0].series},
        linestyle="none" if several else "-",
    )
    missed = [(r.amplitude, getattr(r, quantity)) for r in levels if r.status.startswith("no")]
    missed = [(x, y) for x, y in missed if y > 0]
    if missed:
        ax.plot(*zip(*missed, strict=True), "x", color="black", markersize=6, zorder=6)

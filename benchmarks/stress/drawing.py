"""Figures of the ladders: how small det F and the residual become, and a surrogate's errors."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.stress.case import LoadLevel
from benchmarks.verification.drawing import MARKS, panel, picture
from dpl.visualization import COLOURS

LABELS = {
    "volume_ratio": "smallest min det F [-]",
    "residual": "||R|| / ||f|| of the end [-]",
    "error": "relative error against Newton [-]",
}


def draw(rungs: Sequence[LoadLevel], path: Path) -> None:
    """Draw ladders of loads, a panel for min det F and one for the residual.

    Where rungs have errors a third panel shows them; the range of the training is shaded. A cross
    marks a load without an answer.

    Args:
        rungs: Of all ladders.
        path: Of the picture.
    """
    wanted = ["volume_ratio", "residual"]
    if any(rung.error > 0 for rung in rungs):
        wanted.append("error")
    names = list(dict.fromkeys(rung.series for rung in rungs))
    with picture(path, 3.4 + 0.16 * math.ceil(len(names) / 3)) as figure:
        for place, quantity in enumerate(wanted, 1):
            title = f"({'abc'[place - 1]})"
            ax = panel(
                figure, place, "load / range [-]", LABELS[quantity], title, columns=len(wanted)
            )
            ax.set(xscale="log", yscale="log")
            ax.axvspan(min(rung.amplitude for rung in rungs), 1.0, color="0.95", zorder=0)
            for k, name in enumerate(names):
                _draw_series(ax, [r for r in rungs if r.series == name], quantity, k)
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)


def _draw_series(ax: Any, rungs: Sequence[LoadLevel], quantity: str, k: int) -> None:
    """Draw one ladder, its unanswered loads crossed out."""
    colour = COLOURS[k % len(COLOURS)]
    style = {"marker": MARKS[k // len(COLOURS) % len(MARKS)], "markersize": 2.8, "linewidth": 0.8}
    several = len({rung.amplitude for rung in rungs}) < len(rungs)
    points = [(r.amplitude, getattr(r, quantity)) for r in rungs]
    drawn = [(x, y) for x, y in points if y > 0]  # a logarithmic axis has no others
    ax.plot(
        *([x for x, _ in drawn], [y for _, y in drawn]),
        **{**style, "color": colour, "label": rungs[0].series},
        linestyle="none" if several else "-",
    )
    missed = [(r.amplitude, getattr(r, quantity)) for r in rungs if r.status.startswith("no")]
    missed = [(x, y) for x, y in missed if y > 0]
    if missed:
        ax.plot(*zip(*missed, strict=True), "x", color="black", markersize=6, zorder=6)

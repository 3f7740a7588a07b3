"""Figures in one style: black for references, colour for dpl, readable without colour."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.verification.bodies import Array
from dpl.visualization import COLOURS

MARKS = "osD^vP"


def panel(figure: Any, place: int, x: str, y: str, title: str = "", **options: Any) -> Any:
    """Return labelled axes of a figure."""
    ax = figure.add_subplot(1, options.pop("columns", 2), place)
    ax.set(xlabel=x, ylabel=y, **options)
    ax.set_title(title, loc="left")
    ax.grid(True)
    return ax


def measured(ax: Any, x: Any, y: Any, k: int, label: str | None = None, **style: Any) -> None:
    """Draw measured values, the k-th series."""
    how = {"color": COLOURS[k], "marker": MARKS[k], "markersize": 3.8, "linewidth": 1.0}
    ax.plot(x, y, **{**how, "label": label, **style})


def reference(ax: Any, x: Any, y: Any, label: str | None = None) -> None:
    """Draw reference values as open circles."""
    ax.plot(
        *(x, y, "o"),
        **{"markersize": 6.5, "markerfacecolor": "none", "markeredgecolor": "black"},
        **{"markeredgewidth": 0.8, "label": label, "zorder": 5},
    )


def triangle(ax: Any, x: float, y: float, order: int, *, rise: float = 2.0) -> None:
    """Draw a triangle of a given order into a logarithmic plot, its right angle lower right."""
    left, low = x / rise, y / rise**order
    ax.fill([left, x, x], [low, low, y], facecolor="none", edgecolor="black", linewidth=0.7)
    ax.annotate(
        f"{order}", (x, math.sqrt(low * y)), (3, 0), textcoords="offset points", va="center"
    )


def side(ax: Any, places: Array, nodes: NDArray[np.int_], colour: str, step: int = 1) -> None:
    """Draw a grid in a plane.

    Args:
        ax: Where.
        places: Of the nodes, (N, 2).
        nodes: By their places in the grid, see `lattice`, (n1, n2).
        colour: Of cells and edges.
        step: Nodes from one cell to the next, the degree of the displacement.
    """
    from matplotlib.collections import LineCollection

    seen = places[nodes]
    outline = np.concatenate([seen[:, 0], seen[-1], seen[::-1, -1], seen[0, ::-1]])
    ax.fill(*outline.T, facecolor=colour, alpha=0.3, linewidth=0)
    lines = [*seen[::step], *seen.swapaxes(0, 1)[::step]]
    ax.add_collection(LineCollection(lines, colors=colour, linewidths=0.6))


def curve(ax: Any, x: Any, y: Any, label: str | None = None, linestyle: str = "-") -> None:
    """Draw a known curve."""
    ax.plot(x, y, color="black", linewidth=0.8, linestyle=linestyle, label=label, zorder=4)

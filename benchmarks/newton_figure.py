"""Figure of the loads that Newton solves from rest and from predictions."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.newton_starts import REFERENCE, Trial
from dpl.visualization import COLOURS, DPI

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LABEL_STEP = 9.0  # smallest distance of two labels [% of the loads]
# solvers of a panel, with the label and the style of their lines; each needs no network or one
LINES = {
    "plain Newton": ("plain Newton", "0.1", "-"),
    REFERENCE: (REFERENCE, "0.1", "--"),
    "hybrid, paper's rule": ("paper's hybrid", COLOURS[1], "-"),
    "hybrid, natural monotonicity": ("our hybrid", COLOURS[0], "-"),
}
QUANTITIES = (("iterations", "iterations"), ("ms", "time [ms]"))


def draw(trials: Sequence[Trial], path: Path, *, limit: int | None = None) -> None:
    """Draw the fraction of solved loads over iterations and over time, a column for each network.

    The tolerance is the middle one of those measured. A panel has at most four lines, `LINES`; the
    other solvers are only in the table.

    Source: Dolan, More (2002), Benchmarking optimization software with performance profiles; here
    with absolute numbers.

    Args:
        trials: Results of all solvers for all loads.
        path: Path of the picture.
        limit: Number of iterations that is marked; None: no mark.
    """
    from matplotlib.figure import Figure

    tols = sorted({trial.tol for trial in trials})
    shown = [trial for trial in trials if trial.tol == tols[len(tols) // 2]]
    networks = list(dict.fromkeys(t.network for t in shown if t.network)) or [""]
    figure = Figure(figsize=(3.3 * len(networks) + 0.5, 5.2), dpi=DPI, layout="constrained")
    axes = figure.subplots(2, len(networks), sharey=True, sharex="row", squeeze=False)
    for column, network in zip(axes.T, networks, strict=True):
        own = [trial for trial in shown if trial.network in ("", network)]
        for ax, (quantity, label) in zip(column, QUANTITIES, strict=True):
            _draw_panel(ax, own, quantity)
            ax.set(ylim=(0, 104), xlabel=label)
        title = f"predictions of {network}" if network else ""
        column[0].set_title(title, loc="left", fontsize=9.5)
        if limit is not None:
            column[0].axvline(limit, color="0.6", lw=0.8, ls=":")
    for ax in axes[:, 0]:
        ax.set_ylabel("solved loads [%]")
    _note(figure, shown[0].tol)
    figure.savefig(path)


def _draw_panel(ax: Any, trials: Sequence[Trial], quantity: str) -> None:
    """Draw one line for each solver of `LINES` that was measured, with a label at its end."""
    lines = {solver: [t for t in trials if t.solver == solver] for solver in LINES}
    lines = {solver: own for solver, own in lines.items() if own}
    right = max(getattr(trial, quantity) for own in lines.values() for trial in own)
    heights = []
    for solver, own in lines.items():
        values = sorted(getattr(trial, quantity) for trial in own if trial.converged)
        parts = [100 * k / len(own) for k in range(len(values) + 1)]
        heights.append(parts[-1])
        x = [*(values[:1] or [right]), *values, right]
        y = [*parts, parts[-1]]
        _, colour, style = LINES[solver]
        ax.step(x, y, where="post", color=colour, ls=style, lw=1.4)
    for solver, height in zip(lines, _spread(heights), strict=True):
        label, colour, _ = LINES[solver]
        ax.annotate(
            label, (1.0, height), xycoords=("axes fraction", "data"), xytext=(4, 0),
            textcoords="offset points", color=colour, va="center", fontsize=7.5,
        )  # fmt: skip
    if quantity == "ms":
        ax.set_xscale("log")
    ax.grid(alpha=0.3)


def _spread(heights: Sequence[float]) -> list[float]:
    """Return heights of labels that are at least `LABEL_STEP` apart, in the order of the lines."""
    order = sorted(range(len(heights)), key=lambda k: -heights[k])
    placed = list(heights)
    top = 100.0 + LABEL_STEP
    for k in order:
        top = placed[k] = min(heights[k], top - LABEL_STEP)
    return placed


def _note(figure: "Figure", tol: float) -> None:
    figure.suptitle(f"Loads solved to ||R|| / ||f|| < {tol:g}", x=0.01, ha="left", fontsize=9.5)

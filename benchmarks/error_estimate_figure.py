"""Figure and conclusion of `benchmarks.error_estimates`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.error_estimates import EXACT, LEAST, SAID, Estimate
from benchmarks.study import picture
from dpl.visualization import COLOURS

BAND = (1 / 3, 3.0)  # ratios that the figure marks [-]


def conclude(found: Sequence[Estimate]) -> None:
    """Print how many answers say too little, and how good small estimates are."""
    pairs = np.array([(one.estimated, one.error) for one in found])
    estimated, error = pairs[pairs[:, 1] > EXACT].T
    said = estimated < SAID
    ratios = estimated / error
    small = np.quantile(ratios[estimated < 0.01], (0.01, 0.05, 0.5, 0.95))
    infinite = np.isinf(pairs[:, 0])
    large = ratios[(error > 1) & np.isfinite(estimated)]
    print(
        f"{len(found)} answers, {infinite.sum()} with an infinite estimate\n"
        f"{said.sum()} say less than {SAID:.0%}: {(ratios[said] < LEAST).sum()} of them less than "
        f"a third of the error, at least {ratios[said].min():.2g} times\n"
        f"stated below 1 %: {', '.join(map(_short, small))} times (1, 5, 50, 95 %)\n"
        f"errors above 100 %: at least {_short(min(large, default=np.nan))} times"
    )


def _short(ratio: float) -> str:
    """Return a ratio in at most six characters."""
    return (
        f"{ratio:.0f}" if 10 <= ratio < 1e5 else f"{ratio:.2g}" if ratio > 1e-2 else f"{ratio:.0e}"
    )


def draw(found: Sequence[Estimate], path: Path) -> None:
    """Draw estimated over true error against the true error, a panel for each body."""
    bodies = list(dict.fromkeys(one.body for one in found))
    with picture(path, 3.0 * max(len(bodies), 1.4) + 0.6, 3.6) as figure:
        axes = figure.subplots(1, len(bodies), sharey=True, squeeze=False)[0]
        for ax, body in zip(axes, bodies, strict=True):
            _draw_body(ax, [one for one in found if one.body == body])
            ax.set_title(body)
        axes[0].set_ylabel("estimated / true error")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(5, 2 * len(bodies)))


def _draw_body(ax: Any, found: Sequence[Estimate]) -> None:
    ax.axhspan(*BAND, color="0.93", lw=0)
    ax.axhline(1.0, color="0.5", lw=0.7)
    for k, loads in enumerate(dict.fromkeys(one.loads for one in found)):
        own = [one for one in found if one.loads == loads and one.error > EXACT]
        errors = np.array([one.error for one in own])
        ratios = np.array([one.estimated for one in own]) / errors
        ax.plot(errors, ratios, "o", ms=2.4, color=COLOURS[k], mew=0, alpha=0.5, label=loads)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("true relative error")
    ax.grid()

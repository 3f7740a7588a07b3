"""Table and figure of `benchmarks.error_estimates`."""

from collections.abc import Sequence
from dataclasses import astuple
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks.error_estimates import IN_RANGE, TWICE, Estimate, Row
from dpl.visualization import COLOURS, DPI, STYLE

WIDTH = 100  # of the table [characters]
BAND = (0.5, 2.0)  # ratios that the figure marks [-]
ESTIMATORS = {"corotational": "corotational correction", "modes": "correction in the modes"}
SHORT = {IN_RANGE: "in range", TWICE: "twice"}
CAPTION = (
    "Estimated over true error, 5 %, 50 % and 95 % of the loads; C: corotational correction, "
    "M: correction in the modes, S: error of the simulator, inf: loads with an infinite one."
)


def show(rows: Sequence[Row]) -> None:
    """Print the quantiles of all rows as one table."""
    table = Table(box=box.SIMPLE, padding=(0, 1, 0, 0), caption=CAPTION, caption_justify="left")
    table.add_column("", no_wrap=True)
    shares = [f"{estimator} {share}" for estimator in "CMS" for share in ("5", "50", "95")]
    for name in ("error", *shares, "inf"):
        table.add_column(name, justify="right", no_wrap=True)
    for (body, loads), group in groupby(rows, key=lambda row: (row.body, row.loads)):
        table.add_section()
        table.add_row(f"[bold]{body}, {SHORT[loads]}[/]")
        for row in group:
            ratios = astuple(row)[-len(shares) :]
            cells = ["" if np.isnan(value) else _short(value) for value in ratios]
            table.add_row(row.prediction, f"{row.error:.0e}", *cells, f"{row.unknown or ''}")
    Console(width=WIDTH).print(table)


def _short(ratio: float) -> str:
    """Return a ratio in at most six characters."""
    return (
        f"{ratio:.0f}" if 10 <= ratio < 1e5 else f"{ratio:.2g}" if ratio > 1e-2 else f"{ratio:.0e}"
    )


def draw(found: Sequence[Estimate], path: Path) -> None:
    """Draw estimated over true error against the true error, a panel for each body."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    bodies = list(dict.fromkeys(one.body for one in found))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.0 * max(len(bodies), 1.4) + 0.6, 3.6), layout="constrained")
        axes = figure.subplots(1, len(bodies), sharey=True, squeeze=False)[0]
        for ax, body in zip(axes, bodies, strict=True):
            _draw_body(ax, [one for one in found if one.body == body])
            ax.set_title(body)
        axes[0].set_ylabel("estimated / true error")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(4, 2 * len(bodies)))
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=DPI)


def _draw_body(ax: Any, found: Sequence[Estimate]) -> None:
    ax.axhspan(*BAND, color="0.93", lw=0)
    ax.axhline(1.0, color="0.5", lw=0.7)
    for k, (name, title) in enumerate(ESTIMATORS.items()):
        for loads, filled in ((IN_RANGE, True), (TWICE, False)):
            own = [one for one in found if one.loads == loads]
            errors = np.array([one.error for one in own])
            ratios = np.array([getattr(one, name) for one in own]) / errors
            if np.isnan(ratios).all():
                continue  # no model has modes
            face = COLOURS[k] if filled else "none"
            ax.plot(
                errors, ratios, "o", ms=2.8, mfc=face, mec=COLOURS[k], mew=0.5, alpha=0.6,
                label=f"{title}, {loads}",
            )  # fmt: skip
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("true relative error")
    ax.grid()

"""Figures of `benchmarks.ablation`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.ablation import ABLATION, CURVE, Row
from benchmarks.study import METHOD_COLOURS, picture
from dpl import Sample
from dpl.models import Unrolled
from dpl.visualization import COLOURS, draw_body

COLOUR = METHOD_COLOURS["unrolled"]


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the learning curve over loads and over minutes, and the errors of the ablation."""
    learnt = [row for row in rows if row.part == CURVE]
    with picture(path, 11, 3.6) as figure:
        over_loads, over_minutes, variants = figure.subplots(1, 3, width_ratios=(1, 1, 1.2))
        _draw_curve(over_loads, [row.samples for row in learnt], learnt)
        over_loads.set_xlabel("loads that are solved")
        solved = [row.data_seconds for row in learnt if row.data_seconds is not None]
        if len(solved) == len(learnt):
            pairs = zip(solved, learnt, strict=True)
            minutes = [(seconds + row.fit_seconds) / 60 for seconds, row in pairs]
            _draw_curve(over_minutes, minutes, learnt)
            over_minutes.set_xlabel("data and fit [min]")
        else:
            over_minutes.remove()
        _draw_variants(variants, [row for row in rows if row.part == ABLATION])


def _draw_curve(ax: Any, x: Sequence[float], rows: Sequence[Row]) -> None:
    from matplotlib.ticker import LogLocator

    ax.loglog(x, [row.e_mean for row in rows], "o-", color=COLOUR, ms=4, label="prediction")
    corrected = [row.e_mean_corrected for row in rows]
    ax.loglog(x, corrected, "s--", color=COLOUR, mfc="white", ms=4, label="after one step")
    ax.set_ylabel("$e_{mean}$")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_minor_formatter("")  # labels of minor ticks would overlap
    ax.xaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_major_formatter("{x:.0e}")
    ax.grid(which="both")
    ax.legend(loc="upper right")


def _draw_variants(ax: Any, rows: Sequence[Row]) -> None:
    names = [row.variant for row in rows]
    ax.plot([row.e_mean for row in rows], names, "o", color=COLOUR, ms=5, label="prediction")
    corrected = [row.e_mean_corrected for row in rows]
    ax.plot(corrected, names, "s", color=COLOUR, mfc="white", ms=4, label="after one step")
    ax.set_xscale("log")
    ax.xaxis.set_minor_formatter("")  # labels of minor ticks would overlap
    ax.invert_yaxis()
    ax.grid(which="both")
    ax.set_xlabel("$e_{mean}$")
    if rows:
        ax.set_title(f"ablation, {rows[0].samples} loads", loc="left")
    ax.legend()


def draw_method(net: Unrolled, test: Sample, path: Path) -> None:
    """Draw the steps of a prediction for the test load with the largest displacement.

    Args:
        net: The fitted model.
        test: Solved loads.
        path: Of the picture.
    """
    panels = _panels(net, test)
    shapes = [panel.displacement for panel in panels if panel.displacement is not None]
    problem = net.scene.problem
    kind = {"projection": "3d"} if problem.shape[1] == 3 else {}
    with picture(path, 13, 2.1) as figure:
        figure.set_layout_engine("none")
        figure.subplots_adjust(0.01, 0.0, 0.99, 0.8, wspace=0.12)
        axes = figure.subplots(1, len(panels), subplot_kw=kind)
        for ax, panel in zip(axes, panels, strict=True):
            draw_body(
                ax, problem, panel.displacement, values=panel.values, colours="YlOrRd", fit=shapes
            )
            ax.set_title(panel.title)
            if panel.points is not None:
                ax.computed_zorder = False  # of axes in 3D: the points lie inside the body
                ax.scatter(*panel.points.T.numpy(), s=3, color=COLOURS[1], zorder=3)
        for k in range(1, len(panels)):
            place = k / len(panels), 0.35
            figure.text(*place, "\N{RIGHTWARDS ARROW}", fontsize=20, ha="center", color="0.3")


class _Panel(NamedTuple):
    """A body that is drawn: title, displacement over L (N, D), values at nodes (N,), points."""

    title: str
    displacement: Tensor | None = None
    values: Tensor | None = None
    points: Tensor | None = None


def _panels(net: Unrolled, test: Sample) -> list[_Panel]:
    """Return the steps of a prediction for the test load with the largest displacement."""
    problem, k = net.scene.problem, int(test.displacement.flatten(1).norm(dim=1).argmax())
    load = test.load.unbatch()[k]
    with torch.inference_mode():
        predicted = net(load.force, *((load.parameters,) if net.extra_inputs else ()))
        loaded = load.force.flatten(1)[:, net.dofs]
        linear = problem.prescribed.flatten().clone()
        linear[net.dofs] = net.linear(loaded, load.parameters)[0]
        linear = linear.view(problem.shape)
        unbalanced = problem.residual(predicted, load.force)[0].norm(dim=1)
        solver = net.correction()
        last = predicted[0]
        if solver is not None:
            last = solver.correct(load.force[0], last, parameters=load.parameters[0], steps=1)
    sampled = f"strain or stress $\\varphi(G c)$\nat {len(net.cells)} cells"
    centres = (problem.points + linear)[problem.cells[net.cells]].mean(dim=1)
    return [
        _Panel("load $f$", values=load.force[0].norm(dim=1)),
        _Panel("linear solution\n$K(0)^{-1} f$", linear),
        _Panel(sampled, linear, points=centres),
        _Panel(
            f"$K(0)^{{-1}} f + V c$\n{1 + len(net.maps)} maps $c \\leftarrow c + \\varphi B_k$",
            predicted[0],
        ),
        _Panel("residual\n$r = f - f_{int}(u)$", predicted[0], unbalanced),
        _Panel("Newton step in the modes\n$V^T K(u) V s = V^T r$", last),
    ]

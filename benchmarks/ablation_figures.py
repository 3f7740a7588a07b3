"""Figures of `benchmarks.ablation`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.ablation import ABLATION, CURVE, Row
from benchmarks.study import METHOD_COLOURS, dots, dots_legend, picture
from dpl import Sample
from dpl.models import Unrolled
from dpl.visualization import COLOURS, draw_body

COLOUR = METHOD_COLOURS["unrolled"]


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the learning curve over loads and over minutes, and the errors of the ablation."""
    learnt = [row for row in rows if row.part == CURVE]
    left_out = [row for row in rows if row.part == ABLATION]
    with picture(path, 5.6) as figure:
        axes = figure.subplot_mosaic([["loads", "minutes"], ["variants", "variants"]])
        _draw_curve(axes["loads"], [row.samples for row in learnt], learnt)
        axes["loads"].set_xlabel("loads that are solved")
        solved = [row.data_seconds for row in learnt if row.data_seconds is not None]
        if len(solved) == len(learnt):
            pairs = zip(solved, learnt, strict=True)
            minutes = [(seconds + row.fit_seconds) / 60 for seconds, row in pairs]
            _draw_curve(axes["minutes"], minutes, learnt)
            axes["minutes"].set_xlabel("data and fit [min]")
        else:
            axes["minutes"].remove()
        ax, errors = axes["variants"], [row.e_mean for row in left_out]
        corrected = [row.e_mean_corrected for row in left_out]
        dots(ax, [row.variant for row in left_out], errors, corrected, [COLOUR] * len(errors))
        ax.set(xscale="log", xlabel="$e_{mean}$")
        _set_ticks(ax.xaxis, "{x:.0e}")
        ax.set_title(f"ablation, {left_out[0].samples} loads" if left_out else "", loc="left")
        dots_legend(figure, "prediction", "after one step in the modes")


def _draw_curve(ax: Any, x: Sequence[float], rows: Sequence[Row]) -> None:
    ax.loglog(x, [row.e_mean for row in rows], "o-", color=COLOUR, ms=4)
    corrected = [row.e_mean_corrected for row in rows]
    ax.loglog(x, corrected, "o--", color=COLOUR, mfc="white", ms=4)
    ax.set_ylabel("$e_{mean}$")
    _set_ticks(ax.xaxis, "{x:g}")
    _set_ticks(ax.yaxis, "{x:.0e}")
    ax.grid(visible=True)


def _set_ticks(axis: Any, form: str) -> None:
    """Put labelled ticks at 1, 2 and 5 of each decade."""
    from matplotlib.ticker import LogLocator

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(form)
    axis.set_minor_formatter("")


def draw_method(net: Unrolled, test: Sample, path: Path) -> None:
    """Draw the steps of a prediction for the test load with the largest displacement."""
    panels = _panels(net, test)
    shapes = [panel.displacement for panel in panels if panel.displacement is not None]
    problem = net.scene.problem
    kind = {"projection": "3d"} if problem.shape[1] == 3 else {}
    with picture(path, 4.4) as figure:
        figure.set_layout_engine("none")
        room = {"left": 0.01, "bottom": -0.02, "right": 0.99, "top": 0.9}
        axes = figure.subplots(2, 3, subplot_kw=kind, gridspec_kw={**room, "hspace": 0.25})
        for k, (ax, panel) in enumerate(zip(axes.flat, panels, strict=True)):
            draw_body(
                ax, problem, panel.displacement, values=panel.values, colours="YlOrRd", fit=shapes
            )
            if kind:
                sides = ax.get_xlim(), ax.get_ylim(), ax.get_zlim()
                ax.set_box_aspect([high - low for low, high in sides], zoom=1.4)
            ax.set_title(f"{k + 1}. {panel.title}")
            if panel.points is not None:
                ax.computed_zorder = False  # of axes in 3D: the points lie inside the body
                ax.scatter(*panel.points.T.numpy(), s=3, color=COLOURS[1], zorder=3)


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
            *_, state = solver.states(load, guess=predicted[:1], max_iter=1)
            last = state.displacement[0]
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

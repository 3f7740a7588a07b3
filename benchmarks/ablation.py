"""Learning curve and ablation of model=unrolled: python scripts/ablation.py [experiment=...].

Fits the model to 64, 128, ... loads, and variants of it to `ablation_loads` loads, and measures it
on other loads. Writes the rows, a figure of them and a figure of the method.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from hydra.utils import get_object
from omegaconf import DictConfig
from torch import Tensor

from benchmarks import CONF, paper_tables
from benchmarks.local_loads import linear_solution
from benchmarks.samples import first, scaled, solved
from benchmarks.study import METHOD_COLOURS, dots, dots_legend, label_decades, picture, record
from dpl import Sample, config
from dpl.commands.cli import command
from dpl.fem import Material, ModalLoads
from dpl.models import Unrolled
from dpl.models.unrolled import features
from dpl.system.threads import one_thread
from dpl.training.metrics import errors_of
from dpl.visualization import COLOURS, draw_body

Build = Callable[..., Unrolled]
OTHER_STREAM = 7  # of loads far out of range and of local loads
OTHER_SETS = {"small": "0.01 to 0.1 of the range", "twice": "1 to 2 times the range"}
LOCAL_RADIUS = 0.05  # largest radius of the area of local loads over L [-]
CURVE, ABLATION, OTHER_LOADS = PARTS = "learning curve", "ablation", "other loads"
STRESSES = {"R^T dP": 0, "dP": 1}  # position in the features


@dataclass(frozen=True)
class Variant:
    """A variant of the model."""

    name: str  # its name
    options: Mapping[str, Any] = field(default_factory=dict)  # arguments of `Unrolled` that differ
    # returns a context in which the variant is fitted and evaluated
    change: Callable[[], AbstractContextManager[Any]] = nullcontext


WHOLE = Variant("all")


@dataclass(frozen=True)
class Row:
    """Errors of one variant on one set of loads."""

    part: str  # "learning curve", "ablation" or "other loads"
    variant: str  # name of the variant or of the set of loads
    samples: int  # number of loads that it was fitted to
    count: int  # number of loads on which the errors were measured
    # e_mean, e_max, SNR_min, rel_L2_median, rel_L2_worst: See `dpl.training.metrics`
    e_mean: float
    e_max: float
    SNR_min: float
    rel_L2_median: float
    rel_L2_worst: float
    e_mean_corrected: float  # e_mean after one step of Newton's method in the modes
    rel_L2_worst_corrected: float  # largest relative error after this step
    fit_seconds: float  # wall time of the fit on one thread [s]
    modes: int  # number of modes that the fit chose
    # wall time in which the loads of the fit were solved [s]; None if not recorded
    data_seconds: float | None = None


def variants(options: Mapping[str, Sequence[Any]]) -> list[Variant]:
    """Return the variants of the ablation."""
    fixed = [
        WHOLE,
        Variant("without symmetry", {"symmetry": False}),
        *(Variant(f"{name} only", change=_OneStress(k)) for name, k in STRESSES.items()),
    ]
    sizes = [
        Variant(f"{name} = {value}", {name: value})
        for name, values in options.items()
        for value in values
    ]
    return fixed + sizes


@dataclass(frozen=True)
class _OneStress:
    """Context in which all features but one are zero, so that their maps are zero."""

    kept: int

    def __call__(self) -> AbstractContextManager[Any]:
        both = features.unbalanced_stress

        def unbalanced_stress(law: Material, H: Tensor, rest: Tensor) -> Tensor:
            stress = both(law, H, rest)
            own = slice(9 * self.kept, 9 * self.kept + 9)
            one = torch.zeros_like(stress)
            one[..., own, :] = stress[..., own, :]
            return one

        return mock.patch.object(features, "unbalanced_stress", unbalanced_stress)


def fitted(
    variant: Variant, build: Build, samples: Sample, held_out: Sample, test: Sample, part: str
) -> tuple[Row, Unrolled]:
    """Fit a variant; return its row and the model."""
    # compiled loops have features and precision of their own, which no variant changes
    without_loops = mock.patch.object(Unrolled, "_is_compiled", return_value=False)
    with variant.change(), without_loops, one_thread():
        net = build(**variant.options)
        start = time.perf_counter()
        net.fit(samples, held_out)
        seconds = time.perf_counter() - start
        found = errors(net, test) | {"fit_seconds": seconds, "modes": net.modes.shape[1]}
        row = Row(part, variant.name, len(samples.force), **found)
    return row, net


def other_loads(net: Unrolled, row: Row, test: Sample, count: int) -> Iterator[Row]:
    """Yield the errors of a fitted model on loads of other sizes and on small areas."""
    scene, stream = net.scene, (0, OTHER_STREAM)
    sets = paper_tables.load_sets(scene, test, count)
    found = {title: sets[name] for name, title in OTHER_SETS.items()}
    far = scaled(scene, OTHER_STREAM, torch.full((count,), 3.0).double())
    found["3 times the range"] = solved(scene, far)
    if isinstance(scene.loads, ModalLoads):
        local = replace(scene.loads, patch_radius=(0.0, LOCAL_RADIUS))
        title = f"areas up to {LOCAL_RADIUS:g} L"
        found[title] = solved(scene, local.sample(stream, range(count)))
    for title, samples in found.items():
        if len(samples.force):
            with one_thread():
                yield replace(row, part=OTHER_LOADS, variant=title, **errors(net, samples))


def errors(net: Unrolled, samples: Sample) -> dict[str, Any]:
    """Return the errors of a model, before and after one step in its modes, by name of `Row`."""
    with torch.inference_mode():
        predicted = net(samples.force, samples.parameters)
        solver = net.correction()
        corrected = predicted
        if solver is not None:
            pairs = zip(samples.load.unbatch(), predicted, strict=True)
            steps = [
                list(solver.states(load, guess=u[None], max_iter=1, error_tol=0.0))[-1]
                for load, u in pairs
            ]
            corrected = torch.stack([state.displacement[0] for state in steps])
    before, after = (errors_of(net.scene.problem, u, samples) for u in (predicted, corrected))
    known = {one.name for one in fields(Row)}
    return {
        "count": len(samples.force),
        **{name: value for name, value in before.items() if name in known},
        "e_mean_corrected": after["e_mean"],
        "rel_L2_worst_corrected": after["rel_L2_worst"],
    }


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
        label_decades(ax.xaxis, "{x:.0e}")
        ax.set_title(f"ablation, {left_out[0].samples} loads" if left_out else "", loc="left")
        dots_legend(figure, "prediction", "after one step in the modes")


def _draw_curve(ax: Any, x: Sequence[float], rows: Sequence[Row]) -> None:
    ax.loglog(x, [row.e_mean for row in rows], "o-", color=COLOUR, ms=4)
    corrected = [row.e_mean_corrected for row in rows]
    ax.loglog(x, corrected, "o--", color=COLOUR, mfc="white", ms=4)
    ax.set_ylabel("$e_{mean}$")
    label_decades(ax.xaxis)
    label_decades(ax.yaxis, "{x:.0e}")
    ax.grid(visible=True)


def draw_method(net: Unrolled, test: Sample, path: Path) -> None:
    """Draw the steps of a prediction for the test load with the largest displacement."""
    panels = _panels(net, test)
    shapes = [displacement for _, displacement, *_ in panels if displacement is not None]
    problem = net.scene.problem
    kind = {"projection": "3d"} if problem.shape[1] == 3 else {}
    with picture(path, 4.4) as figure:
        figure.set_layout_engine("none")
        room = {"left": 0.01, "bottom": -0.02, "right": 0.99, "top": 0.9}
        axes = figure.subplots(2, 3, subplot_kw=kind, gridspec_kw={**room, "hspace": 0.25})
        for ax, (title, displacement, values, points) in zip(axes.flat, panels, strict=True):
            draw_body(ax, problem, displacement, values=values, colours="YlOrRd", fit=shapes)
            if kind:
                sides = ax.get_xlim(), ax.get_ylim(), ax.get_zlim()
                ax.set_box_aspect([high - low for low, high in sides], zoom=1.4)
            ax.set_title(title)
            if points is not None:
                ax.computed_zorder = False  # of axes in 3D: the points lie inside the body
                ax.scatter(*points.T.numpy(), s=3, color=COLOURS[1], zorder=3)


def _panels(net: Unrolled, test: Sample) -> list[tuple[str, Tensor | None, Tensor | None, Any]]:
    """Return the steps of a prediction for the test load with the largest displacement.

    A step has a title, a displacement over L (N, D), values at nodes (N,) and points to mark.
    """
    problem, k = net.scene.problem, int(test.displacement.flatten(1).norm(dim=1).argmax())
    load = test.load.unbatch()[k]
    with torch.inference_mode():
        predicted = net(load.force, load.parameters)
        linear = linear_solution(net, load)[0]
        unbalanced = problem.residual(predicted, load.force)[0].norm(dim=1)
        solver = net.correction()
        last = predicted[0]
        if solver is not None:
            *_, state = solver.states(load, guess=predicted[:1], max_iter=1)
            last = state.displacement[0]
    sampled = f"strain or stress $\\varphi(G c)$\nat {len(net.cells)} cells"
    centres = (problem.points + linear)[problem.cells[net.cells]].mean(dim=1)
    mapped = f"{1 + len(net.maps)} maps $c \\leftarrow c + \\varphi B_k$"
    return [
        ("1. load $f$", None, load.force[0].norm(dim=1), None),
        ("2. linear solution\n$K(0)^{-1} f$", linear, None, None),
        (f"3. {sampled}", linear, None, centres),
        (f"4. $K(0)^{{-1}} f + V c$\n{mapped}", predicted[0], None, None),
        ("5. residual\n$r = f - f_{int}(u)$", predicted[0], unbalanced, None),
        ("6. Newton step in the modes\n$V^T K(u) V s = V^T r$", last, None, None),
    ]


KEYS = (
    (Sequence[int], "counts", 1, 10**7),
    (int, "ablation_loads", 1, 10**7),
    (dict, "options"),
)


@command("ablation", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Fit all variants, print one table and write rows and figures."""
    needed = max(cfg.ablation_loads, *cfg.counts)
    if cfg.data.train < needed:
        raise config.ConfigError(
            f"data.train = {cfg.data.train} must be {needed} or more, the largest of counts and "
            "ablation_loads"
        )
    scene = config.build_scene(cfg)
    build = partial(config.instantiate, cfg, "model", scene=scene)
    if get_object(cfg.model._target_) is not Unrolled:
        raise config.ConfigError("model must be unrolled; its parts are left out one by one")
    every = variants(cfg.options)
    for variant in every:  # invalid options are refused before loads are solved
        build(**variant.options)
    data = config.load_data(cfg, scene)
    samples, held_out, test = (data.samples(split) for split in ("train", "val", "test"))
    seconds = data.store.seconds_per_load()
    folder = Path(cfg.folder)

    def rows() -> Iterator[Row]:
        for count in cfg.counts:
            yield fitted(WHOLE, build, first(samples, count), held_out, test, CURVE)[0]
        some = first(samples, cfg.ablation_loads)
        for variant in every:
            row, net = fitted(variant, build, some, held_out, test, ABLATION)
            yield row
            if variant == WHOLE:
                draw_method(net, test, folder / "unrolled_method.png")
                whole = net, row
        yield from other_loads(*whole, test, cfg.count)

    def timed() -> Iterator[Row]:
        for row in rows():
            solved = None if seconds is None else seconds * (row.samples + len(held_out.force))
            yield replace(row, data_seconds=solved)
            print(f"{row.part}, {row.variant}, {row.samples} loads: e_mean {row.e_mean:.2g}")

    title = "unrolled: learning curve, ablation, other loads; 1 thread"
    record(timed(), folder / "unrolled", title, draw)

"""Calibrate the estimated errors of the simulator: python scripts/error_estimates.py.

Compares the estimated with the true errors of answers of the simulator: in range, at twice the
range, and under loads that compress, twist and pinch the body. Trains models on several bodies, or
takes those of a folder of runs (run=runs/beam_nh_loss), which get no loads of the latter kind.
Writes the errors of all answers, quantiles of their ratios and a figure.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, cast

import lightning as L
import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from benchmarks import CONF, peers
from benchmarks.methods import load_runs
from benchmarks.samples import first, solved
from benchmarks.study import OTHER_COLOURS, picture, record
from dpl import Sample, Scene, config, fem
from dpl.commands.cli import command
from dpl.data import DataModule
from dpl.evaluation.tables import power
from dpl.inference import Simulator
from dpl.models import FCNN, PODNet, Unrolled
from dpl.training import MSE, Muon, RMSELoss, Surrogate, fit

IN_RANGE, TWICE = "in range", "twice the range"
CALLS: Mapping[str, Mapping[str, Any]] = {"": {}} | {
    f"{name}={power(value)}": {name: value}
    for name, value in (("error", 1e-2), ("error", 1e-3), ("tol", 1e-3), ("tol", 1e-6))
}
MODES = 60  # of the correction of `pod`
SHARES = (0.05, 0.5, 0.95)  # quantiles of the ratio
SAID = 0.1  # estimated error below which an answer must not be too good [-]
LEAST = 1 / 3  # ratio of estimated and true error below which it is [-]
LOAD_COLOURS = ("0.25", *OTHER_COLOURS)  # no loads have the colour of a method
EXACT = 1e-7  # true error that the tolerance of the solutions decides [-]


@dataclass(frozen=True)
class Estimate:
    """True and estimated relative error of an answer of the simulator."""

    # body, prediction, loads, call: names of the body, the model, the set of loads and the call
    body: str
    prediction: str
    loads: str
    call: str
    method: str  # method that computed the answer
    error: float  # ||u - v|| / ||v|| with the solution v [-]
    estimated: float  # `error` of the answer [-]


@dataclass(frozen=True)
class Row:
    """Distribution of the ratio of estimated and true error over the answers of a group."""

    # body, prediction, loads: See `Estimate`
    body: str
    prediction: str
    loads: str
    count: int  # number of answers
    unknown: int  # number of answers with an infinite estimate, which the quantiles leave out
    error: float  # median of the true relative error [-]
    # p5, median, p95: quantiles of the ratio [-]
    p5: float
    median: float
    p95: float
    least: float  # smallest ratio of an answer whose estimate is below `SAID` [-]; NaN without any
    missed: int  # number of these answers whose ratio is below `LEAST`


def block(size: Sequence[float], nodes: Sequence[int], **options: Any) -> Scene:
    """Return a block of NH-ln that is clamped at its end of smallest x."""
    options = {"fixed": fem.Plane(0, "min"), **options}
    return _scene(fem.Problem.build(fem.box(size, nodes), fem.NeoHookeanLn(0.3), **options))


def bracket() -> Scene:
    """Return an L-bracket of quadratic tetrahedra, nearly incompressible."""
    whole = fem.box([1.0, 1.0, 0.25], [7, 7, 3], "tetra")
    x, y = whole.p[:2, whole.t].mean(axis=1)
    mesh = whole.restrict(np.flatnonzero((x < 1 / 3) | (y < 1 / 3)))
    problem = fem.Problem.build(mesh, fem.NeoHookeanLn(0.45), fixed=fem.Plane(1, "max"), degree=2)
    return _scene(problem)


def _scene(problem: fem.Problem) -> Scene:
    newton = fem.Newton(problem)
    return Scene(problem, fem.ModalLoads(newton.linear_solver, deflection=0.4), newton)


BODIES: Mapping[str, Callable[[], Scene]] = {
    "beam": partial(block, [100.0, 25.0, 25.0], [17, 5, 5]),  # the default one
    "column": partial(block, [100.0, 10.0, 10.0], [25, 4, 4]),  # ten times as long as thick
    "propeller": peers.propeller_scene,
    "bracket": bracket,
    # quadratic cells, fifty times as long as thick
    "plate": partial(block, [100.0, 50.0, 2.0], [13, 7, 2], degree=2),
}


def softened(scene: Scene, count: int, seed: int = 0) -> dict[str, Sample]:
    """Return solved loads that may soften the body, by name: compressed, twisted and pinched.

    The forces on the face of largest x act against x, about x, or squeeze the outer half along z.
    Compression and squeezing are 0.3 to 0.98 times the critical load; torsion deflects the body
    linearly by 0.04 to 0.4 L. A force across, of random direction, deflects it linearly by 4e-6 to
    0.04 L. Loads without a stable solution are left out.
    """
    problem, rng = scene.problem, np.random.default_rng(seed)
    points = problem.points
    middle = (points.amin(0) + points.amax(0)) / 2
    end, outer = points[:, 0] > points[:, 0].max() - 1e-9, points[:, 0] > middle[0]
    upper, lower = (outer & (sign * (points[:, 2] - middle[2]) > 0) for sign in (1, -1))
    arms = points - middle
    zero = torch.zeros(problem.shape, dtype=torch.float64)
    axial, twist, pinch = zero.clone(), zero.clone(), zero.clone()
    axial[end, 0] = -1.0
    twist[end, 1], twist[end, 2] = -arms[end, 2], arms[end, 1]
    pinch[:, 2] = lower.double() * upper.sum() - upper.double() * lower.sum()
    kinds = {"compressed": axial, "twisted": twist, "pinched": pinch}
    found = {}
    for name, force in kinds.items():
        force = force / _deflection(scene, force)
        sizes = rng.uniform(0.04, 0.4, count)
        if name != "twisted":
            sizes = rng.uniform(0.3, 0.98, count) * _critical(scene, force)
        loads = []
        for size, small in zip(sizes, 10 ** rng.uniform(-5, -1, count), strict=True):
            across = zero.clone()
            across[end, 1:] = torch.from_numpy(rng.standard_normal(2))
            loads.append(size * force + 0.4 * small * across / _deflection(scene, across))
        samples = solved(scene, fem.Load(torch.stack(loads), torch.ones(count).double()))
        stable = [_is_stable(scene, u[None]) for u in samples.displacement]
        found[name] = Sample(*(column[stable] for column in samples))
    return found


def _deflection(scene: Scene, force: Tensor) -> float:
    """Return the largest linear displacement of a node over L under a force (N, D) [-]."""
    return float(scene.linear.solve_force(force).norm(dim=1).max())


def _is_stable(scene: Scene, displacement: Tensor) -> bool:
    return not scene.newton.stability(displacement)


def _critical(scene: Scene, force: Tensor) -> float:
    """Return the factor of a force (N, D) [-] at which the body becomes unstable."""

    def is_stable(factor: float) -> bool:
        found = fem.solve(scene.newton, fem.Load(factor * force[None], torch.ones(1).double()))
        return bool(found.converged) and _is_stable(scene, found.displacement)

    high = 1e-4
    while is_stable(high) and high < 1.0:
        high *= 2
    low = high / 2
    for _ in range(10):
        middle = (low + high) / 2
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return low


def estimates(
    body: str,
    scene: Scene,
    samples: Sample,
    simulators: Mapping[str, Simulator],
    more: Mapping[str, Sample] = {},  # not changed
) -> Iterator[Estimate]:
    """Yield true and estimated errors of the answers of simulators."""
    doubled = solved(scene, samples.load._replace(force=2 * samples.force))
    for title, some in {IN_RANGE: samples, TWICE: doubled, **more}.items():
        for name, sim in simulators.items():
            for call, options in CALLS.items():
                for found in measured(sim, some, options):
                    yield replace(found, body=body, prediction=name, loads=title, call=call)


def measured(sim: Simulator, samples: Sample, options: Mapping[str, Any]) -> Iterator[Estimate]:
    """Yield true and estimated errors of answers to solved loads; the names are empty."""
    for load, exact in zip(samples.load.unbatch(), samples.displacement, strict=True):
        inputs: dict[str, Any] = {k: v[0] for k, v in sim.scene.si_inputs(load).items()}
        answer = sim(**inputs, **options)
        error = float((answer.displacement / sim.scene.length - exact).norm() / exact.norm())
        yield Estimate("", "", "", "", answer.method, error, answer.error)


def trained(scene: Scene, data: DataModule, epochs: int) -> dict[str, Simulator]:
    """Return simulators with surrogates of several accuracies, by name."""
    torch.manual_seed(0)
    muon = partial(Muon, lr=5e-3)
    surrogates = {
        "fcnn": Surrogate(FCNN(scene, width=64), MSE(), scene, optimizer=muon),
        "pod": Surrogate(PODNet(scene, rank=60), RMSELoss(), scene, optimizer=muon),
        "unrolled": Surrogate(Unrolled(scene), MSE(), scene),
    }
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    for surrogate in surrogates.values():
        if surrogate.predictor.is_closed_form:
            fit(surrogate, data)
            continue
        trainer = L.Trainer(
            max_epochs=epochs, accelerator="cpu", enable_checkpointing=False,
            check_val_every_n_epoch=epochs, **quiet,
        )  # fmt: skip
        trainer.fit(surrogate, datamodule=data)
    states = data.samples("train").displacement
    found = {name: Simulator(surrogate) for name, surrogate in surrogates.items()}
    vectors = cast(PODNet, surrogates["pod"].net).vectors[..., :MODES]
    newton = fem.SubspaceNewton.within(scene.problem, vectors, states[:256], tolerance=1e-2)
    found["pod + modes"] = Simulator(surrogates["pod"], newton=newton)
    return found


def summarised(found: Sequence[Estimate]) -> list[Row]:
    """Return a row for each body, prediction and set of loads."""
    rows = []
    named = sorted(found, key=lambda one: (one.body, one.loads))  # stable
    for names, group in groupby(named, key=lambda one: (one.body, one.prediction, one.loads)):
        members = [one for one in group if one.error > EXACT]
        errors = np.array([one.error for one in members])
        ratios = np.array([one.estimated for one in members]) / errors
        finite = ratios[np.isfinite(ratios)]
        quantiles = np.quantile(finite, SHARES) if len(finite) else [math.nan] * len(SHARES)
        said = ratios[[one.estimated < SAID for one in members]]
        rows.append(
            Row(
                *names,
                count=len(members),
                unknown=len(ratios) - len(finite),
                error=float(np.median(errors)) if len(errors) else math.nan,
                p5=float(quantiles[0]),
                median=float(quantiles[1]),
                p95=float(quantiles[2]),
                least=float(said.min()) if len(said) else math.nan,
                missed=int((said < LEAST).sum()),
            )
        )
    return rows


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
        f"stated below 1 %: {', '.join(f'{x:.2g}' for x in small)} times (1, 5, 50, 95 %)\n"
        f"errors above 100 %: at least {min(large, default=math.nan):.2g} times"
    )


def draw(rows: Sequence[Estimate], path: Path) -> None:
    """Draw estimated over true error against the true error, a panel for each body."""
    bodies = list(dict.fromkeys(one.body for one in rows))
    kinds = list(dict.fromkeys(one.loads for one in rows))
    lines = math.ceil(len(bodies) / 2)
    with picture(path, 2.4 * lines + 0.6) as figure:
        axes = figure.subplots(lines, min(len(bodies), 2), sharex=True, sharey=True, squeeze=False)
        for ax, body in zip(axes.flat, bodies, strict=False):
            ax.axhspan(LEAST, 1 / LEAST, color="0.93", lw=0)
            ax.axhline(1.0, color="0.5", lw=0.7)
            for colour, loads in zip(LOAD_COLOURS, kinds, strict=False):
                own = [one for one in rows if (one.body, one.loads) == (body, loads)]
                own = [one for one in own if one.error > EXACT]
                errors = np.array([one.error for one in own])
                ratios = np.array([one.estimated for one in own]) / errors
                ax.plot(errors, ratios, "o", ms=2.6, color=colour, mew=0, alpha=0.6, label=loads)
            ax.set(xscale="log", yscale="log", title=body)
            ax.grid(visible=True)
        for ax in axes[:, 0]:
            ax.set_ylabel("estimated / true error")
        for ax in axes[-1]:
            ax.set_xlabel("true relative error")
        for ax in axes.flat[len(bodies) :]:
            ax.remove()
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5, markerscale=2.5)


COUNTS = tuple((int, name, 1, 10**6) for name in ("train", "val", "test", "epochs", "softened"))
KEYS = ((Sequence[str], "bodies"), (str, "name"), *COUNTS)


@command("error_estimates", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Compare the estimates on all bodies, print one table and write rows and a figure."""
    if not cfg.bodies or set(cfg.bodies) - set(BODIES):
        names = ", ".join(BODIES)
        raise config.ConfigError(f"bodies = {list(cfg.bodies)} must be some of {names}")
    folder = Path(cfg.folder)
    found = list(_of_runs(cfg) if cfg.run else _of_bodies(cfg, folder))
    record(found, folder / f"{cfg.name}_loads", None, draw)
    title = "estimated over true error of all answers, 1 thread"
    record(summarised(found), folder / cfg.name, title)
    conclude(found)


def _of_bodies(cfg: DictConfig, folder: Path) -> Iterator[Estimate]:
    """Yield the estimates of models that are trained on each body."""
    for body in cfg.bodies:
        start = time.perf_counter()
        scene = BODIES[body]()
        print(*scene.describe()[0], flush=True)
        sizes = {"train": cfg.train, "val": cfg.val, "test": cfg.test, "workers": 0}
        data = DataModule(scene, folder=str(folder / "data" / body), **sizes)
        data.prepare_data()
        simulators = trained(scene, data, cfg.epochs)
        test = first(data.samples("test"), cfg.test)
        yield from estimates(body, scene, test, simulators, softened(scene, cfg.softened))
        print(f"{body}: {time.perf_counter() - start:.0f} s", flush=True)


def _of_runs(cfg: DictConfig) -> Iterator[Estimate]:
    """Yield the estimates of all runs in a folder."""
    runs = load_runs(cfg.run)
    run, surrogate = next(iter(runs.values()))
    scene = surrogate.scene
    test = first(config.load_data(run, scene).samples("test"), cfg.test)
    simulators = {name: Simulator(surrogate) for name, (_, surrogate) in runs.items()}
    yield from estimates(Path(cfg.run).name, scene, test, simulators)

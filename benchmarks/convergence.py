"""Newton from zero and from predictions: python scripts/convergence.py run=runs/beam_svk.

Extends experiment 4 of Odot, Haferssas, Cotin (2022), DeepPhysics.
"""

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.progress import Progress

from benchmarks import CONF
from benchmarks.methods import load_runs
from benchmarks.plain_newton import PlainNewton
from benchmarks.samples import scaled
from benchmarks.study import dots, dots_legend, method_colours, picture, record
from dpl import config
from dpl.commands.cli import command
from dpl.evaluation.timing import time_interleaved
from dpl.fem import AndersonSolver, Load, Solver
from dpl.inference import Hybrid
from dpl.inference.hybrid import Predict
from dpl.scene import Scene
from dpl.system.threads import one_thread

PLAIN = ("plain Newton", "hybrid, paper's rule")  # solvers without safeguards
REFERENCE = "robust Newton"  # solver with which times and displacements are compared
# random streams of the sets of loads; 2 is the stream of the test loads
STREAMS = {"in range": 2, "twice": 4}
BOTH = "in range and twice"  # the set of loads in the paper


@dataclass(frozen=True)
class Setting:
    """A solver, a set of loads and a tolerance."""

    solver: str  # name of the solver
    network: str  # name of the network that predicts the initial state; empty for rest
    loads: str  # name of the set of loads
    tol: float  # relative residual [-]


@dataclass(frozen=True)
class Trial(Setting):
    """Result of one solver for one load."""

    number: int  # index of the load in its set
    converged: bool  # the residual is below the tolerance and no element is inverted
    used_prediction: bool  # the solver iterated from the prediction
    iterations: int  # number of linear solves
    factorisations: int  # number of factorised tangents
    ms: float  # wall time with the prediction [ms]
    deviation: float  # relative L2 distance from the solution of robust Newton [-]


@dataclass(frozen=True)
class Summary(Setting):
    """Results of one solver for a set of loads; means and medians are over converged loads."""

    count: int  # number of loads
    converged: float  # fraction of converged loads [%]
    # fraction of loads for which the solver used the prediction [%]
    used_prediction_pct: float | None = None
    iterations: float | None = None  # mean number of linear solves
    max_iterations: int | None = None  # maximum number of linear solves
    factorisations: float | None = None  # mean number of factorised tangents
    ms: float | None = None  # median wall time with the prediction [ms]
    # total wall time over that of robust Newton, for loads where both converged [-]
    time_ratio: float | None = None
    # largest relative L2 distance from the solution of robust Newton, for loads where both
    # converged [-]
    deviation: float | None = None


# Odot, Haferssas, Cotin (2022), table 7: 50 loads in range and 50 of up to twice the range
PAPER = [
    Summary("paper: Newton", "", BOTH, math.nan, 100, 46, None, 6.1),
    Summary("paper: hybrid Newton", "", BOTH, math.nan, 100, 71, 66, 5.0),
]


def load_sets(scene: Scene, count: int, *, twice: bool = True) -> dict[str, Load]:
    """Return `count` test loads, and as many that are scaled by 1 to 2."""
    part = torch.linspace(0, 1, count, dtype=torch.float64)
    factors = {"in range": 1 + 0 * part} | ({"twice": 1 + part} if twice else {})
    return {name: scaled(scene, STREAMS[name], factor) for name, factor in factors.items()}


def solvers_of(
    scene: Scene,
    networks: Mapping[str, Predict],
    tol: float,
    *,
    names: Sequence[str] | None = None,
) -> dict[tuple[str, str], Solver]:
    """Return the solvers to compare, by name and network; `REFERENCE` is always one of them."""
    robust, quick = (replace(one, tol=tol) for one in (scene.newton, scene.corrector))
    plain: Any = PlainNewton(robust)  # has what the hybrid uses of Newton
    solvers: dict[tuple[str, str], Solver] = {
        ("plain Newton", ""): plain,
        ("plain Newton, load steps", ""): replace(
            robust, mixed_integration=False, factor_reuse_tol=0.0
        ),
        (REFERENCE, ""): robust,
        ("robust Newton, corotational", ""): replace(robust, corotational=True),
    }
    for name, predict in networks.items():
        solvers["hybrid, paper's rule", name] = Hybrid(predict, plain, "paper")
        solvers["hybrid, natural monotonicity, factors", name] = Hybrid(predict, robust)
        solvers["hybrid, natural monotonicity", name] = Hybrid(predict, quick)
        anderson = AndersonSolver(quick)
        solvers["hybrid, without tangents", name] = Hybrid(predict, quick, steps=anderson)
    known = list(dict.fromkeys(name for name, _ in solvers))
    wanted = {REFERENCE, *(known if names is None else names)}
    if unknown := wanted.difference(known):
        raise ValueError(f"{sorted(unknown)} must be names of solvers: {', '.join(known)}")
    return {key: solver for key, solver in solvers.items() if key[0] in wanted}


def measure(
    solvers: Mapping[tuple[str, str], Solver],
    title: str,
    load: Load,
    tol: float,
    tick: Callable[[], None] = lambda: None,
) -> list[Trial]:
    """Return the results of all solvers for all loads, one load at a time on one thread."""
    with one_thread(), torch.inference_mode():
        timed = time_interleaved(solvers, load, tick)
    reference = timed[REFERENCE, ""][0].displacement.flatten(1)
    trials = []
    for (name, network), (solution, times) in timed.items():
        distance = (solution.displacement.flatten(1) - reference).norm(dim=1)
        columns = (
            solution.converged, solution.from_guess, solution.iterations, solution.factorisations,
            times, distance / reference.norm(dim=1),
        )  # fmt: skip
        numbers = zip(*(column.tolist() for column in columns), strict=True)
        trials += [Trial(name, network, title, tol, k, *row) for k, row in enumerate(numbers)]
    return trials


def limited(trials: Sequence[Trial], limit: int) -> list[Trial]:
    """Return the results of `PLAIN` solvers as they are if iterations end at a limit.

    A plain Newton method does not depend on its limit before it is reached. A load that needs more
    iterations has not converged. The limit includes one that the paper's rule discards.
    """
    return [
        replace(
            trial,
            solver=f"{trial.solver}, at most {limit} iterations",
            converged=trial.converged and trial.iterations <= limit,
            iterations=min(trial.iterations, limit),
        )
        for trial in trials
        if trial.solver in PLAIN
    ]


def summary(trials: Sequence[Trial]) -> list[Summary]:
    """Return a summary for each solver, set of loads and tolerance.

    The sets "in range" and "twice" are also combined into the set of the paper, `BOTH`, if there
    are both. The loads of a set have the same order for all solvers.
    """
    groups: dict[tuple[str, float], dict[tuple[str, str], list[Trial]]] = {}
    near = [trial for trial in trials if trial.loads in ("in range", "twice")]
    both = [replace(trial, loads=BOTH) for trial in near]
    for trial in [*(both if {t.loads for t in near} == {"in range", "twice"} else []), *trials]:
        group = groups.setdefault((trial.loads, trial.tol), {})
        group.setdefault((trial.solver, trial.network), []).append(trial)
    return [
        _summarise(own, group[REFERENCE, ""]) for group in groups.values() for own in group.values()
    ]


def _summarise(trials: Sequence[Trial], reference: Sequence[Trial]) -> Summary:
    def reduced(reduce: Callable[[list[Any]], float], values: Iterable[Any]) -> Any:
        found = list(values)
        return reduce(found) if found else None

    first, count = trials[0], len(trials)
    done = [trial for trial in trials if trial.converged]
    both = [pair for pair in zip(trials, reference, strict=True) if all(t.converged for t in pair)]
    used = 100 * sum(trial.used_prediction for trial in trials) / count
    return Summary(
        *(first.solver, first.network, first.loads, first.tol, count),
        converged=100 * len(done) / count,
        used_prediction_pct=used if first.network else None,
        iterations=reduced(statistics.mean, (trial.iterations for trial in done)),
        max_iterations=reduced(max, (trial.iterations for trial in done)),
        factorisations=reduced(statistics.mean, (trial.factorisations for trial in done)),
        ms=reduced(statistics.median, (trial.ms for trial in done)),
        time_ratio=sum(own.ms for own, _ in both) / sum(ref.ms for _, ref in both)
        if both
        else None,
        deviation=reduced(max, (own.deviation for own, _ in both)),
    )


def draw(rows: Sequence[Summary], path: Path) -> None:
    """Draw converged loads, iterations and time of the solvers on the loads nearest to the paper's.

    The tolerance is the middle one of those measured.
    """
    measured = [row for row in rows if not math.isnan(row.tol)]  # without those of the paper
    loads = BOTH if any(row.loads == BOTH for row in measured) else measured[0].loads
    tols = sorted({row.tol for row in measured})
    shown = [r for r in measured if (r.loads, r.tol) == (loads, tols[len(tols) // 2])]
    names = [f"{row.solver}\nfrom {row.network}" if row.network else row.solver for row in shown]
    colours = method_colours(row.network or "Newton" for row in shown)
    own, none = [colours[row.network or "Newton"] for row in shown], [None] * len(shown)
    with picture(path, 0.32 * len(shown) + 1.0) as figure:
        converged, iterations, time = figure.subplots(1, 3, sharey=True)
        dots(converged, names, [row.converged for row in shown], none, own)
        means, most = zip(*((row.iterations, row.max_iterations) for row in shown), strict=True)
        dots(iterations, names, means, most, own)
        dots(time, names, [row.time_ratio for row in shown], none, own)
        converged.set(xlabel="converged loads [%]", xlim=(0, 105))
        iterations.set(xlabel="iterations", xlim=(0, None))
        time.set(xlabel="time / robust Newton", xlim=(0, None))
        dots_legend(figure, "mean", "most")


KEYS = (
    (bool, "twice"),
    (Sequence[str] | None, "solvers"),
    (int | None, "max_plain_iterations", 1, 10**6),
)


@command("convergence", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure all solvers on all loads; write rows, machine and figure."""
    runs = load_runs(cfg.run, cfg.networks, trust=cfg.trust)
    scene = next(iter(runs.values()))[1].scene
    networks = {name: surrogate.predict for name, (_, surrogate) in runs.items()}
    sets = load_sets(scene, cfg.count, twice=cfg.twice)
    trials: list[Trial] = []
    with Progress() as progress:
        bar = progress.add_task("loads", total=len(cfg.tols) * len(sets) * cfg.count)
        for tol in cfg.tols:
            with config.error_in("solvers", ValueError):
                solvers = solvers_of(scene, networks, tol, names=cfg.solvers)
            for name, load in sets.items():
                trials += measure(solvers, name, load, tol, partial(progress.advance, bar))
    limit = cfg.max_plain_iterations
    within = [] if limit is None else limited(trials, limit)
    rows = PAPER + summary([*trials, *within])
    record(rows, Path(cfg.folder) / cfg.name, f"{cfg.name}, one load at a time, 1 thread", draw)

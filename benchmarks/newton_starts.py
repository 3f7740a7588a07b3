"""Convergence of Newton started from rest and from predictions.

Extends experiment 4 of Odot, Haferssas, Cotin (2022), DeepPhysics.
"""

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from benchmarks.plain_newton import PlainNewton
from dpl.evaluation.timing import time_interleaved
from dpl.fem import AndersonSolver, Load, Solver
from dpl.inference import Hybrid
from dpl.inference.hybrid import Predict
from dpl.scene import Scene
from dpl.system.threads import one_thread

PLAIN = ("plain Newton", "hybrid, paper's rule")  # solvers without safeguards
REFERENCE = "robust Newton"  # solver with which times and displacements are compared
# random streams of the sets of loads; 2 is the stream of the test loads
STREAMS = {"in range": 2, "twice": 4, "3 times": 7, "5 times": 8}
BOTH = "in range and twice"  # the set of loads in the paper


@dataclass(frozen=True)
class Setting:
    """A solver, a set of loads and a tolerance.

    Attributes:
        solver: Name of the solver.
        network: Name of the network that predicts the initial state; empty for rest.
        loads: Name of the set of loads.
        tol: Relative residual [-].
    """

    solver: str
    network: str
    loads: str
    tol: float


@dataclass(frozen=True)
class Trial(Setting):
    """Result of one solver for one load.

    Attributes:
        number: Index of the load in its set.
        converged: The residual is below the tolerance and no element is inverted.
        used_prediction: The solver iterated from the prediction.
        iterations: Number of linear solves.
        factorisations: Number of factorised tangents.
        ms: Wall time with the prediction [ms].
        deviation: Relative L2 distance from the solution of robust Newton [-].
        step_tol, max_total_iter: Options of the solvers, see `solvers_of`.
    """

    number: int
    converged: bool
    used_prediction: bool
    iterations: int
    factorisations: int
    ms: float
    deviation: float
    step_tol: float = 0.0
    max_total_iter: int | None = None


@dataclass(frozen=True)
class Summary(Setting):
    """Results of one solver for a set of loads; means and medians are over converged loads.

    Attributes:
        count: Number of loads.
        converged: Fraction of converged loads [%].
        used_prediction_pct: Fraction of loads for which the solver used the prediction [%].
        iterations: Mean number of linear solves.
        max_iterations: Maximum number of linear solves.
        factorisations: Mean number of factorised tangents.
        ms: Median wall time with the prediction [ms].
        time_ratio: Total wall time over that of robust Newton, for loads where both converged [-].
        deviation: Largest relative L2 distance from the solution of robust Newton, for loads where
            both converged [-].
    """

    count: int
    converged: float
    used_prediction_pct: float | None = None
    iterations: float | None = None
    max_iterations: int | None = None
    factorisations: float | None = None
    ms: float | None = None
    time_ratio: float | None = None
    deviation: float | None = None


# Odot, Haferssas, Cotin (2022), table 7: 50 loads in range and 50 of up to twice the range
PAPER = [
    Summary("paper: Newton", "", BOTH, math.nan, 100, 46, None, 6.1),
    Summary("paper: hybrid Newton", "", BOTH, math.nan, 100, 71, 66, 5.0),
]


def load_sets(scene: Scene, count: int, far: int, *, twice: bool = True) -> dict[str, Load]:
    """Return `count` test loads, as many scaled by 1 to 2, and `far` loads scaled by 3 and by 5.

    Args:
        scene: The scene.
        count: Number of loads.
        far: Number of loads of the last two sets.
        twice: Whether the second set is returned.
    """
    part = torch.linspace(0, 1, count, dtype=torch.float64)
    factors = {"in range": 1 + 0 * part} | ({"twice": 1 + part} if twice else {})
    factors |= {f"{k} times": torch.full((far,), float(k)).double() for k in (3, 5)}
    sets = {}
    for name, factor in factors.items():
        if len(factor):
            drawn = scene.loads.sample((0, STREAMS[name]), range(len(factor)))
            sets[name] = drawn._replace(force=factor[:, None, None] * drawn.force)
    return sets


def solvers_of(
    scene: Scene,
    networks: Mapping[str, Predict],
    tol: float,
    *,
    max_total_iter: int | None = None,
    step_tol: float = 0.0,
    names: Sequence[str] | None = None,
) -> dict[tuple[str, str], Solver]:
    """Return the solvers to compare, by name and network.

    Args:
        scene: The scene.
        networks: Predictions by the name of their network.
        tol: Relative residual [-].
        max_total_iter: Largest number of iterations of the solvers with safeguards; None: that of
            the scene's solver.
        step_tol: Norm of a step that ends plain Newton, see `PlainNewton` [-].
        names: Names of the solvers; None: all. `REFERENCE` is always one of them.

    Raises:
        ValueError: A name belongs to no solver.
    """
    budget = max_total_iter or scene.newton.max_total_iter
    robust = replace(scene.newton, tol=tol, max_total_iter=budget)
    quick = replace(scene.corrector, tol=tol, max_total_iter=budget)
    plain = PlainNewton(robust, step_tol=step_tol)
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
    *,
    step_tol: float = 0.0,
    max_total_iter: int | None = None,
) -> list[Trial]:
    """Return the results of all solvers for all loads, one load at a time on one thread.

    Args:
        solvers: Solvers by name and network, which contain `REFERENCE` from rest.
        title: Name of the set of loads, for the record.
        load: The loads.
        tol: Relative residual of the solvers, for the record [-].
        tick: Called after each load.
        step_tol, max_total_iter: Options of the solvers, for the record, see `solvers_of`.
    """
    with one_thread(), torch.inference_mode():
        timed = time_interleaved(solvers, load, tick)
    reference = timed[REFERENCE, ""][0].displacement.flatten(1)
    options: dict[str, Any] = {"step_tol": step_tol, "max_total_iter": max_total_iter}
    trials = []
    for (name, network), (solution, times) in timed.items():
        distance = (solution.displacement.flatten(1) - reference).norm(dim=1)
        columns = (
            solution.converged, solution.from_guess, solution.iterations, solution.factorisations,
            times, distance / reference.norm(dim=1),
        )  # fmt: skip
        numbers = zip(*(column.tolist() for column in columns), strict=True)
        trials += [
            Trial(name, network, title, tol, k, *row, **options) for k, row in enumerate(numbers)
        ]
    return trials


def limited(trials: Sequence[Trial], limit: int) -> list[Trial]:
    """Return the results of `PLAIN` solvers as they are if iterations end at a limit.

    A plain Newton method does not depend on its limit before it is reached. A load that needs more
    iterations has not converged.

    Args:
        trials: Results with a larger limit.
        limit: Largest number of iterations, including one that the paper's rule discards.
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

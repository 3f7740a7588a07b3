"""Newton from rest and from predictions: who converges, in how many iterations, and how fast.

The paper's experiment 4, and beyond it.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dpl.evaluation.timing import time_interleaved
from dpl.fem import (
    AndersonSolver,
    Load,
    Newton,
    Problem,
    SingularMatrix,
    Solution,
    Solver,
    evaluate_solution,
)
from dpl.fem.solvers import run_lockstep
from dpl.inference import Hybrid
from dpl.inference.hybrid import Predict
from dpl.scene import Scene
from dpl.system.threads import one_thread

DASHES = ("-", "--", ":", "-.")
REFERENCE = "robust Newton"  # what times are compared with
STREAMS = {"in range": 2, "twice": 4, "3 times": 7, "5 times": 8}  # of loads; the first: test loads
BOTH = "in range and twice"  # the loads of the paper

# Odot, Haferssas, Cotin (2022), table 5: converged, prediction picked [%], mean iterations
PAPER = {"paper: Newton": (46, None, 6.1), "paper: hybrid Newton": (71, 66, 5.0)}


@dataclass(frozen=True, eq=False)
class PlainNewton:
    """Newton as in textbooks and in the paper: every step whole, whatever becomes of the body.

    Source: Odot, Haferssas, Cotin (2022), DeepPhysics, algorithm 1.

    Attributes:
        solver: Whose body and linear solver it takes, and its tolerance.
        max_iter: Iterations after which it has not converged.
    """

    solver: Newton
    max_iter: int = 20

    def iterate(self, load: Load, *, guess: Tensor | None = None) -> Iterator[Solution]:
        """Yield the start and the state after each step; loads one by one, in step.

        Args:
            load: What acts.
            guess: Where to start, (B, N, D) [-]; zero if left out.
        """
        guesses = torch.zeros_like(load.force) if guess is None else guess
        yield from run_lockstep(
            [
                self._member(single, u[None], guess is not None)
                for single, u in zip(load.unbatch(), guesses, strict=True)
            ]
        )

    @property
    def problem(self) -> Problem:
        """The body."""
        return self.solver.problem

    @property
    def tol(self) -> float:
        """Residual ratio below which an answer counts as converged [-]."""
        return self.solver.tol

    def _member(self, load: Load, u: Tensor, guessed: bool) -> Iterator[Solution]:
        problem, start = self.solver.problem, time.perf_counter()
        backend = self.solver.linear_solver.tangent_backend
        for k in range(self.max_iter + 1):
            state = evaluate_solution(problem, u, load, self.tol, iterations=k, from_guess=guessed)
            yield state._replace(
                factorisations=torch.tensor([k]),
                seconds=torch.tensor([time.perf_counter() - start], dtype=torch.float64),
            )
            if state.converged or k == self.max_iter:
                return
            system = problem.linearise(u)
            right = problem.restrict((load.force - system.force)[0])
            try:
                factor = backend.factorise(system.tangent[0].numpy())
                u = u + problem.extend(factor.solve(right, 1e-10))[None]
            except SingularMatrix:
                return


@dataclass(frozen=True)
class Asked:
    """What a solver is asked for.

    Attributes:
        solver: Its name.
        network: Whose predictions it starts from; empty: from rest.
        loads: Name of the set.
        tol: Residual ratio asked for [-].
    """

    solver: str
    network: str
    loads: str
    tol: float


@dataclass(frozen=True)
class Trial(Asked):
    """One solver on one load, to one tolerance.

    Attributes:
        number: Of the load in its set.
        converged: Whether it is answered to the tolerance with nothing inverted.
        picked: Whether the answer goes on from the prediction.
        iterations: Linear solves, with a tangent or what stands for one.
        factorisations: Of tangents.
        ms: Wall time, prediction included [ms].
        apart: Relative distance from robust Newton's answer [-].
    """

    number: int
    converged: bool
    picked: bool
    iterations: int
    factorisations: int
    ms: float
    apart: float


@dataclass(frozen=True)
class Row(Asked):
    """One solver, on one set of loads, to one tolerance.

    Attributes:
        count: Loads.
        converged: Answered to the tolerance with nothing inverted [%].
        picked: Answers that go on from the prediction [%].
        iterations: Mean linear solves, with a tangent or what stands for one, of those that
            converged.
        worst: Most of them.
        factorisations: Mean, of those that converged.
        ms: Median wall time of those that converged, prediction included [ms].
        ratio: Wall time of all loads over that of robust Newton, both where both converged [-].
        apart: Largest relative distance from robust Newton's answer, where both converged [-].
    """

    count: int
    converged: float
    picked: float | None = None
    iterations: float | None = None
    worst: int | None = None
    factorisations: float | None = None
    ms: float | None = None
    ratio: float | None = None
    apart: float | None = None


def load_sets(scene: Scene, count: int, far: int) -> dict[str, Load]:
    """Return `count` test loads, as many one to two times, and `far` 3 and 5 times as large."""
    part = torch.linspace(0, 1, count, dtype=torch.float64)
    factors = {"in range": 1 + 0 * part, "twice": 1 + part}
    factors |= {f"{k} times": torch.full((far,), float(k)).double() for k in (3, 5)}
    sets = {}
    for name, factor in factors.items():
        if not len(factor):
            continue
        drawn = scene.loads.sample((0, STREAMS[name]), range(len(factor)))
        sets[name] = drawn._replace(force=factor[:, None, None] * drawn.force)
    return sets


def contestants(
    scene: Scene, networks: Mapping[str, Predict], tol: float, *, budget: int | None = None
) -> dict[tuple[str, str], Solver]:
    """Return the solvers, by name and network, that have the same body and linear solver.

    Args:
        scene: What is simulated.
        networks: Predictions, named.
        tol: Residual ratio [-].
        budget: Iterations before a load is given up; the scene's if left out.
    """
    settings: dict[str, Any] = {"tol": tol}
    settings |= {} if budget is None else {"max_total_iter": budget}
    robust, quick = replace(scene.newton, **settings), replace(scene.corrector, **settings)
    plain = PlainNewton(robust)
    solvers: dict[tuple[str, str], Solver] = {
        ("plain Newton", ""): plain,
        ("plain Newton, load steps", ""): replace(
            robust, mixed_integration=False, factor_reuse_tol=0.0
        ),
        (REFERENCE, ""): robust,
        ("robust Newton, K(0) turned", ""): replace(robust, corotational=True),
    }
    for name, predict in networks.items():
        solvers["hybrid, paper's rule", name] = Hybrid(predict, plain, "paper")
        solvers["hybrid, best rule, factors", name] = Hybrid(predict, robust)
        solvers["hybrid, best rule", name] = Hybrid(predict, quick)
        solvers["hybrid, without tangents", name] = Hybrid(
            predict, quick, steps=AndersonSolver(quick)
        )
    return solvers


def measure(
    solvers: Mapping[tuple[str, str], Solver],
    title: str,
    load: Load,
    tol: float,
    tick: Callable[[], None] = lambda: None,
) -> list[Trial]:
    """Return every solver on every load, one at a time on one thread.

    Args:
        solvers: By name and network; `REFERENCE` from rest among them.
        title: Name of the loads.
        load: B of them.
        tol: What the solvers are to reach [-].
        tick: Called after each load.
    """
    with one_thread(), torch.inference_mode():
        whole = time_interleaved(solvers, load, tick)
    exact = whole[REFERENCE, ""][0].displacement.flatten(1)
    trials = []
    for (name, network), (answer, times) in whole.items():
        apart = (answer.displacement.flatten(1) - exact).norm(dim=1) / exact.norm(dim=1)
        columns = (
            answer.converged, answer.from_guess, answer.iterations, answer.factorisations,
            times, apart,
        )  # fmt: skip
        numbers = zip(*(column.tolist() for column in columns), strict=True)
        trials += [Trial(name, network, title, tol, k, *row) for k, row in enumerate(numbers)]
    return trials


def summary(trials: Iterable[Trial]) -> list[Row]:
    """Return a row for each solver, set of loads and tolerance, the paper's two sets also as one.

    Args:
        trials: Each solver's in the same order.
    """
    groups: dict[tuple[str, float], dict[tuple[str, str], list[Trial]]] = {}
    every = list(trials)
    both = [replace(trial, loads=BOTH) for trial in every if trial.loads in ("in range", "twice")]
    for trial in [*both, *every]:
        group = groups.setdefault((trial.loads, trial.tol), {})
        group.setdefault((trial.solver, trial.network), []).append(trial)
    return [_row(own, group[REFERENCE, ""]) for group in groups.values() for own in group.values()]


def _row(trials: Sequence[Trial], reference: Sequence[Trial]) -> Row:
    first, count = trials[0], len(trials)
    done = [trial for trial in trials if trial.converged]
    row = Row(
        first.solver, first.network, first.loads, first.tol, count, 100 * len(done) / count,
        100 * sum(trial.picked for trial in trials) / count if first.network else None,
    )  # fmt: skip
    if not done:
        return row
    both = [pair for pair in zip(trials, reference, strict=True) if all(t.converged for t in pair)]
    return replace(
        row,
        iterations=statistics.mean(trial.iterations for trial in done),
        worst=max(trial.iterations for trial in done),
        factorisations=statistics.mean(trial.factorisations for trial in done),
        ms=statistics.median(trial.ms for trial in done),
        ratio=sum(own.ms for own, _ in both) / sum(ref.ms for _, ref in both) if both else None,
        apart=max(own.apart for own, _ in both) if both else None,
    )


def paper() -> list[Row]:
    """Return the paper's rows; its 100 loads are half in range, half up to twice."""
    return [
        Row(name, "", BOTH, math.nan, 100, converged, picked, iterations)
        for name, (converged, picked, iterations) in PAPER.items()
    ]


def draw(trials: Sequence[Trial], path: Path) -> None:
    """Draw how many loads each solver has answered within a time, a panel for each tolerance.

    Source: Dolan, More (2002), Benchmarking optimization software with performance profiles, with
    times as they are.

    Args:
        trials: Those to be drawn.
        path: Of the picture.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    tols = list(dict.fromkeys(trial.tol for trial in trials))
    names = list(dict.fromkeys((trial.solver, trial.network) for trial in trials))
    networks = list(dict.fromkeys(network for _, network in names))
    styles: dict[str, str] = {}
    for network in networks:
        of_it = [solver for solver, other in names if other == network]
        styles |= {solver: DASHES[k % len(DASHES)] for k, solver in enumerate(reversed(of_it))}
    figure = Figure(figsize=(3.6 * len(tols) + 2.6, 3.8), layout="constrained")
    axes = figure.subplots(1, len(tols), sharex=True, sharey=True, squeeze=False)[0]
    for ax, tol in zip(axes, tols, strict=True):
        for solver, network in names:
            own = [t for t in trials if (t.tol, t.solver, t.network) == (tol, solver, network)]
            taken = sorted(trial.ms for trial in own if trial.converged)
            part = [100 * k / len(own) for k in range(1, len(taken) + 1)]
            colour = f"C{networks.index(network)}" if network else "0.3"
            label = f"{solver}, {network}" if network else solver
            ax.step(
                taken, part, where="post", color=colour, ls=styles[solver],
                label=label, lw=2 if solver == "hybrid, without tangents" else 1.2,
            )  # fmt: skip
        ax.set_xscale("log")
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.set_ylim(0, 102)
        ax.set_title(f"to ||R|| / ||f|| < {tol:g}", fontsize=10)
        ax.set_xlabel("time [ms]")
        ax.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("loads answered [%]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=8)
    figure.savefig(path, dpi=130)

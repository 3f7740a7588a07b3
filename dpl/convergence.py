"""Newton from rest and from predictions: who converges, in how many iterations, and how fast.

The paper's experiment 4, and beyond it.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from dpl.fem.accelerated import Accelerated
from dpl.fem.linear import SingularMatrix
from dpl.fem.newton import Newton, gather, scatter
from dpl.fem.problem import Problem
from dpl.fem.solution import Load, Solution, Solver, in_step, joined, judge, one_thread, solve
from dpl.hybrid import Hybrid, Predict
from dpl.scene import Scene

DASHES = ("-", "--", ":", "-.")
REFERENCE = "robust Newton"  # what times are compared with
STREAMS = {"in range": 2, "twice": 4, "3 times": 7, "5 times": 8}  # of loads; the first: test loads

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
        yield from in_step(
            [
                self._member(single, u[None], guess is not None)
                for single, u in zip(load.singles(), guesses, strict=True)
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
        for k in range(self.max_iter + 1):
            state = judge(problem, u, load, self.tol, iterations=k, from_guess=guessed)
            yield state._replace(
                factorisations=torch.tensor([k]),
                seconds=torch.tensor([time.perf_counter() - start], dtype=torch.float64),
            )
            if state.converged or k == self.max_iter:
                return
            system = problem.linearise(u)
            right = gather((load.force - system.force)[0], problem)
            try:
                factor = self.solver.factorise(system.tangent[0].numpy())
                u = u + scatter(factor.solve(right, 1e-10), problem)[None]
            except SingularMatrix:
                return


@dataclass(frozen=True)
class Row:
    """One solver, on one set of loads, to one tolerance.

    Attributes:
        solver: Its name.
        network: Whose predictions it starts from; empty: from rest.
        loads: Name of the set.
        tol: Residual ratio asked for [-].
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

    solver: str
    network: str
    loads: str
    tol: float
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
    scene: Scene, networks: Mapping[str, Predict], tol: float
) -> dict[tuple[str, str], Solver]:
    """Return the solvers, by name and network, that have the same body and linear solver.

    Args:
        scene: What is simulated.
        networks: Predictions, named.
        tol: Residual ratio [-].
    """
    robust, quick = scene.solver.but(tol=tol), scene.corrector.but(tol=tol)
    plain = PlainNewton(robust)
    solvers: dict[tuple[str, str], Solver] = {
        ("plain Newton", ""): plain,
        ("plain Newton, load steps", ""): robust.but(mixed=False, reuse=0.0),
        (REFERENCE, ""): robust,
        ("robust Newton, K(0) turned", ""): robust.but(turned=True),
    }
    for name, predict in networks.items():
        solvers["hybrid, paper's rule", name] = Hybrid(predict, plain, "paper")
        solvers["hybrid, best rule, factors", name] = Hybrid(predict, robust)
        solvers["hybrid, best rule", name] = Hybrid(predict, quick)
        solvers["hybrid, without tangents", name] = Hybrid(predict, quick, steps=Accelerated(quick))
    return solvers


def measure(
    solvers: Mapping[tuple[str, str], Solver],
    title: str,
    load: Load,
    tol: float,
    tick: Callable[[], None] = lambda: None,
) -> tuple[list[Row], dict[tuple[str, str], Tensor]]:
    """Return a row for each solver, and its times (B,) [ms], infinite where it did not converge.

    Loads are asked one at a time on one thread; solvers take turns on each.

    Args:
        solvers: By name and network; `REFERENCE` from rest among them.
        title: Name of the loads.
        load: B of them.
        tol: What the solvers are to reach [-].
        tick: Called after each load.
    """
    answers: dict[tuple[str, str], list[Solution]] = {key: [] for key in solvers}
    seconds: dict[tuple[str, str], list[float]] = {key: [] for key in solvers}
    singles = load.singles()
    with one_thread(), torch.inference_mode():
        for solver in solvers.values():
            solve(solver, singles[0])
        for single in singles:
            for key, solver in solvers.items():
                start = time.perf_counter()
                answers[key].append(solve(solver, single))
                seconds[key].append(time.perf_counter() - start)
            tick()
    whole = {key: joined(parts) for key, parts in answers.items()}
    times = {key: 1e3 * torch.tensor(taken).double() for key, taken in seconds.items()}
    reference = whole[REFERENCE, ""], times[REFERENCE, ""]
    rows = [_row(key, title, tol, whole[key], times[key], *reference) for key in solvers]
    return rows, {key: torch.where(whole[key].converged, times[key], math.inf) for key in solvers}


def _row(
    key: tuple[str, str],
    title: str,
    tol: float,
    answer: Solution,
    times: Tensor,
    reference: Solution,
    reference_times: Tensor,
) -> Row:
    done, both = answer.converged, answer.converged & reference.converged
    count = len(done)
    row = Row(*key, title, tol, count, 100 * int(done.sum()) / count)
    if not done.any():
        return row
    apart = (answer.displacement - reference.displacement).flatten(1).norm(dim=1)
    apart = apart / reference.displacement.flatten(1).norm(dim=1)
    numbers = {
        "picked": 100 * int(answer.from_guess.sum()) / count if key[1] else None,
        "iterations": float(answer.iterations[done].double().mean()),
        "worst": int(answer.iterations[done].max()),
        "factorisations": float(answer.factorisations[done].double().mean()),
        "ms": float(times[done].median()),
    }
    if both.any():
        numbers["ratio"] = float(times[both].sum() / reference_times[both].sum())
        numbers["apart"] = float(apart[both].max())
    return Row(**asdict(row) | numbers)


def paper() -> list[Row]:
    """Return the paper's rows; its 100 loads are half in range, half up to twice."""
    return [
        Row(name, "", "in range and twice", math.nan, 100, converged, picked, iterations)
        for name, (converged, picked, iterations) in PAPER.items()
    ]


def draw(times: Mapping[tuple[float, str, str], Tensor], path: Path) -> None:
    """Draw how many loads each solver has answered within a time, a panel for each tolerance.

    Source: Dolan, More (2002), Benchmarking optimization software with performance profiles, with
    times as they are.

    Args:
        times: By tolerance, solver and network, (B,) [ms]; infinite: not answered.
        path: Of the picture.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    tols = list(dict.fromkeys(tol for tol, _, _ in times))
    names = list(dict.fromkeys((solver, network) for _, solver, network in times))
    networks = list(dict.fromkeys(network for _, network in names))
    styles: dict[str, str] = {}
    for network in networks:
        of_it = [solver for solver, other in names if other == network]
        styles |= {solver: DASHES[k % len(DASHES)] for k, solver in enumerate(reversed(of_it))}
    figure = Figure(figsize=(3.6 * len(tols) + 2.6, 3.8), layout="constrained")
    axes = figure.subplots(1, len(tols), sharex=True, sharey=True, squeeze=False)[0]
    for ax, tol in zip(axes, tols, strict=True):
        for solver, network in names:
            taken = times[tol, solver, network].sort().values
            part = 100 * torch.arange(1, len(taken) + 1) / len(taken)
            there = taken.isfinite()
            colour = f"C{networks.index(network)}" if network else "0.3"
            label = f"{solver}, {network}" if network else solver
            ax.step(
                taken[there], part[there], where="post", color=colour, ls=styles[solver],
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

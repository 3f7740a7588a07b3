"""Wall time of solvers, asked one load at a time."""

import time
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

import torch
from torch import Tensor

from dpl.fem.solution import Load, Solution, Solver, joined, solve

K = TypeVar("K", bound=Hashable)


def in_turn(
    solvers: Mapping[K, Solver], load: Load, tick: Callable[[], None] = lambda: None
) -> dict[K, tuple[Solution, Tensor]]:
    """Return the answers and the wall times (B,) [ms] of each solver.

    Every solver is warmed up on the first load, then asked each load alone; the solvers take turns
    on each load, so that a change of the machine's speed meets them all.

    Args:
        solvers: Named.
        load: B of them.
        tick: Called after each load.
    """
    answers: dict[K, list[Solution]] = {name: [] for name in solvers}
    times: dict[K, list[float]] = {name: [] for name in solvers}
    singles = load.singles()
    for solver in solvers.values():
        solve(solver, singles[0])
    for single in singles:
        for name, solver in solvers.items():
            start = time.perf_counter()
            answers[name].append(solve(solver, single))
            times[name].append(1e3 * (time.perf_counter() - start))
        tick()
    return {
        name: (joined(answers[name]), torch.tensor(times[name], dtype=torch.float64))
        for name in solvers
    }


def path(solver: Solver, load: Load) -> list[tuple[float, Solution]]:
    """Return every iterate with the time at which it was there [ms]."""
    found = []
    start = time.perf_counter()
    for state in solver.iterate(load):
        found.append((1e3 * (time.perf_counter() - start), state))
    return found

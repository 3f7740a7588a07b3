"""Wall time of solvers, asked one load at a time."""

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

from dpl.fem import Load, Solution, Solver, solve
from dpl.fem.solvers import concatenate
from dpl.inference import Simulator
from dpl.system.threads import one_thread

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")
WARM_UP = 5  # loads asked before the clock starts
SIMULATOR, NETWORK = "sim(force)", "bare network"  # whose latency is told


@dataclass(frozen=True)
class Latency:
    """Wall time of one call, one load at a time on one thread.

    Attributes:
        loads: Different loads that were asked.
        p50: Median [ms].
        p99: 99th percentile [ms].
    """

    loads: int
    p50: float
    p99: float

    def __str__(self) -> str:
        """Return both percentiles in words."""
        p50, p99 = (f"{float(f'{ms:.2g}'):g}" for ms in (self.p50, self.p99))
        return f"p50 {p50} ms, p99 {p99} ms"


def latency(answer: Callable[[T], object], loads: Sequence[T], *, repeats: int = 1) -> Latency:
    """Return the latency of a callable.

    The first loads are asked before the clock starts. Then the callable has all loads in a row, so
    that its weights stay in the cache as in use.

    Args:
        answer: Is called with one load at a time.
        loads: One or more.
        repeats: How often each is asked.
    """
    taken = []
    with one_thread(), torch.inference_mode():
        for load in loads[:WARM_UP]:
            answer(load)
        for _ in range(repeats):
            for load in loads:
                start = time.perf_counter()
                answer(load)
                taken.append(1e3 * (time.perf_counter() - start))
    return Latency(len(loads), *percentiles(torch.tensor(taken, dtype=torch.float64)))


def percentiles(times: Tensor) -> tuple[float, float]:
    """Return the median and the 99th percentile of times (B,)."""
    return float(times.quantile(0.5)), float(times.quantile(0.99))


def latencies(simulator: Simulator, load: Load) -> dict[str, Latency]:
    """Return the latency of a simulator's call and that of its network, by name.

    `sim(force)` predicts, evaluates the residual and min det F, and judges whether the load lies
    in the range of the training. The bare network is `surrogate(force, young)`: nodal forces go in,
    displacements come out, and nothing is checked.

    Args:
        simulator: Which is asked without a tolerance.
        load: B loads.
    """
    unit = simulator.scene.force_unit * load.young
    columns = {"force": unit[:, None, None] * load.force, "young": load.young}
    if load.poisson.shape[1]:
        columns["poisson"] = load.poisson[:, 0]
    asked: list[dict[str, Any]] = [
        {name: column[k : k + 1] for name, column in columns.items()} for k in range(len(unit))
    ]
    return {
        SIMULATOR: latency(lambda one: simulator(**one), asked),
        NETWORK: latency(lambda one: simulator.surrogate(**one), asked),
    }


def describe(measured: Mapping[str, Latency]) -> str:
    """Return latencies as one line."""
    loads = next(iter(measured.values())).loads
    words = "; ".join(f"{name} {one}" for name, one in measured.items())
    return f"latency, 1 thread, {loads} loads: {words}"


def time_interleaved(
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
    singles = load.unbatch()
    for solver in solvers.values():
        solve(solver, singles[0])
    for single in singles:
        for name, solver in solvers.items():
            start = time.perf_counter()
            answers[name].append(solve(solver, single))
            times[name].append(1e3 * (time.perf_counter() - start))
        tick()
    return {
        name: (concatenate(answers[name]), torch.tensor(times[name], dtype=torch.float64))
        for name in solvers
    }


def time_iterates(solver: Solver, load: Load) -> list[tuple[float, Solution]]:
    """Return every iterate with the time at which it was there [ms]."""
    found = []
    start = time.perf_counter()
    for state in solver.iterate(load):
        found.append((1e3 * (time.perf_counter() - start), state))
    return found

"""Wall times of solvers and simulators, one load at a time."""

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

from dpl.evaluation.tables import NETWORK, SIMULATOR
from dpl.fem import Load, Solution, Solver, solve
from dpl.fem.solvers.solution import concatenate
from dpl.inference import Simulator
from dpl.system.threads import one_thread

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")
WARM_UP = 5  # loads solved before the clock starts


@dataclass(frozen=True)
class Latency:
    """Wall time of one call, one load at a time on one thread."""

    loads: int  # number of different loads
    p50: float  # median [ms]
    p99: float  # 99th percentile [ms]

    def __str__(self) -> str:
        p50, p99 = (f"{float(f'{ms:.2g}'):g}" for ms in (self.p50, self.p99))
        return f"p50 {p50} ms, p99 {p99} ms"


def latency(answer: Callable[[T], object], loads: Sequence[T], *, repeats: int = 1) -> Latency:
    """Return the latency of a callable of a single load, called `repeats` times with each load.

    After a few loads that are not counted, it is called with all loads in a row, so that its
    weights stay in the cache as in use.
    """
    times = []
    with one_thread(), torch.inference_mode():
        for load in loads[:WARM_UP]:
            answer(load)
        for _ in range(repeats):
            for load in loads:
                start = time.perf_counter()
                answer(load)
                times.append(1e3 * (time.perf_counter() - start))
    return Latency(len(loads), *percentiles(torch.tensor(times, dtype=torch.float64)))


def percentiles(times: Tensor) -> tuple[float, float]:
    """Return the median and the 99th percentile of times (B,)."""
    return float(times.quantile(0.5)), float(times.quantile(0.99))


def latencies(simulator: Simulator, load: Load) -> dict[str, Latency]:
    """Return the latencies of a simulator and of its network, by name.

    `sim(force)` predicts, evaluates the residual and min det F, estimates the error, and checks
    whether the load lies in the training range. The bare network, `surrogate(force, young)`, only
    predicts.
    """
    arguments: list[Any] = [simulator.scene.si_inputs(single) for single in load.unbatch()]
    return {
        SIMULATOR: latency(lambda one: simulator(**one), arguments),
        NETWORK: latency(lambda one: simulator.surrogate(**one), arguments),
    }


def time_interleaved(
    solvers: Mapping[K, Solver], load: Load, tick: Callable[[], None] = lambda: None
) -> dict[K, tuple[Solution, Tensor]]:
    """Return the solutions and the wall times (B,) [ms] of each solver.

    Every solver is warmed up with the first load. Solvers are then timed alternately on each load,
    which cancels drifts of the CPU frequency; `tick` is called after each load.
    """
    timed: dict[K, tuple[list[Solution], list[float]]] = {name: ([], []) for name in solvers}
    singles = load.unbatch()
    for solver in solvers.values():
        solve(solver, singles[0])
    for single in singles:
        for name, solver in solvers.items():
            solutions, times = timed[name]
            start = time.perf_counter()
            solutions.append(solve(solver, single))
            times.append(1e3 * (time.perf_counter() - start))
        tick()
    return {
        name: (concatenate(solutions), torch.tensor(times, dtype=torch.float64))
        for name, (solutions, times) in timed.items()
    }

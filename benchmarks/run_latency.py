"""Wall times of a trained run: its prediction, the simulator with its options, and batches."""

import statistics
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from dpl.evaluation import latency
from dpl.evaluation.tables import power
from dpl.fem import Load, solve
from dpl.inference import Simulator
from dpl.system.threads import available_cores, limited_threads, one_thread

BATCHES = (1, 8, 64, 256)  # loads that are predicted by one call
TOLS = (1e-3, 1e-6)  # of calls that are compared with Newton's method [-]
OPTIONS = (  # of calls of the simulator
    {"error": 1e-3}, {"tol": 1e-3}, {"tol": 1e-6},
    *({"tol": 1e-8, "budget_ms": budget} for budget in (10.0, 20.0, 50.0, 100.0)),
)  # fmt: skip


@dataclass(frozen=True)
class CallTime:
    """Wall time of one call with one load on one thread.

    Attributes:
        call: The call.
        loads: Number of different loads.
        p50: Median [ms].
        p99: 99th percentile [ms].
    """

    call: str
    loads: int
    p50: float
    p99: float


@dataclass(frozen=True)
class Throughput:
    """Predictions without checks in batches.

    Attributes:
        batch: Number of loads of a call.
        threads: Number of threads.
        loads_per_second: Median over repeated calls [1/s].
    """

    batch: int
    threads: int
    loads_per_second: float


@dataclass(frozen=True)
class AgainstNewton:
    """Wall times of calls with a tolerance and of Newton's method from rest, on one thread.

    Attributes:
        run: Name of the run.
        tol: Relative residual of the result [-].
        loads: Number of different loads.
        p50, p99: Median and 99th percentile of the calls [ms].
        newton_p50, newton_p99: The same of the reference solver with the same tolerance [ms].
        methods: Number of answers of each method, as text.
    """

    run: str
    tol: float
    loads: int
    p50: float
    p99: float
    newton_p50: float
    newton_p99: float
    methods: str


def against_newton(
    run: str, simulator: Simulator, load: Load, *, repeats: int = 3
) -> Iterator[AgainstNewton]:
    """Yield the times of calls and of Newton's method, which alternate.

    Args:
        run: Name of the run.
        simulator: The simulator.
        load: The loads.
        repeats: Number of timed pairs for each load, of which the medians count.
    """
    scene = simulator.scene
    for tol in TOLS:
        newton = replace(scene.newton, tol=tol)
        times, methods = [], Counter[str]()
        for single in load.unbatch():
            inputs: dict[str, Any] = scene.si_inputs(single)
            pairs = []
            for _ in range(repeats + 1):
                begin = time.perf_counter()
                answer = simulator(**inputs, tol=tol)
                middle = time.perf_counter()
                with one_thread(), torch.inference_mode():
                    solve(newton, single)
                pairs.append((middle - begin, time.perf_counter() - middle))
            times.append(np.median(pairs[1:], axis=0))
            methods.update(answer.method)
        p50, p99 = (1e3 * np.quantile(times, share, axis=0) for share in (0.5, 0.99))
        words = ", ".join(f"{name} {count}" for name, count in methods.most_common())
        yield AgainstNewton(
            run, tol, len(times), float(p50[0]), float(p99[0]), float(p50[1]), float(p99[1]), words
        )


def call_times(simulator: Simulator, load: Load, *, repeats: int = 1) -> Iterator[CallTime]:
    """Yield the wall times of the parts of a call and of calls with several options.

    Calls without a tolerance are also listed by their number of Newton steps in the modes.

    Args:
        simulator: The simulator.
        load: The loads.
        repeats: Number of calls with each load.
    """
    problem, predict = simulator.scene.problem, simulator.surrogate.predict
    singles = load.unbatch()
    inputs: list[Any] = [simulator.scene.si_inputs(single) for single in singles]

    def row(name: str, call: Any, loads: Sequence[Any]) -> CallTime:
        found = latency(call, loads, repeats=repeats)
        return CallTime(name, found.loads, found.p50, found.p99)

    def evaluate(pair: Any) -> None:
        problem.with_parameters(pair[0].parameters).evaluate(pair[1])

    with torch.inference_mode():
        pairs = [(single, predict(single)) for single in singles]
    steps = [int(simulator(**one).iterations[0]) for one in inputs]
    yield row("surrogate.predict", predict, singles)
    yield row("residual and min det F", evaluate, pairs)
    yield row("sim(force)", lambda one: simulator(**one), inputs)
    for count in sorted(set(steps)):
        some = [one for one, own in zip(inputs, steps, strict=True) if own == count]
        yield row(f"  steps in the modes: {count}", lambda one: simulator(**one), some)
    for options in OPTIONS:
        words = "".join(f", {name}={_text(value)}" for name, value in options.items())
        yield row(f"sim(force{words})", lambda one, o=options: simulator(**one, **o), inputs)


def _text(number: float) -> str:
    return power(number) if number < 1 else f"{number:g}"


def throughputs(
    simulator: Simulator, *, batches: Sequence[int] = BATCHES, repeats: int = 5
) -> Iterator[Throughput]:
    """Yield the numbers of predicted loads per second, on one thread and on all cores.

    Args:
        simulator: The simulator.
        batches: Numbers of loads of a call.
        repeats: Number of timed calls after one that is not timed.
    """
    load = simulator.scene.loads.sample((0, 2), range(max(batches)))
    for threads in sorted({1, available_cores()}):
        with limited_threads(threads), torch.inference_mode():
            for batch in batches:
                some = Load(*(column[:batch] for column in load))
                times = [_seconds(simulator, some) for _ in range(repeats + 1)]
                yield Throughput(batch, threads, batch / statistics.median(times[1:]))


def _seconds(simulator: Simulator, load: Load) -> float:
    start = time.perf_counter()
    simulator.surrogate.predict(load)
    return time.perf_counter() - start

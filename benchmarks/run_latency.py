"""Wall times of a trained run: its prediction, and the simulator with its options."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from dpl.evaluation import latency
from dpl.evaluation.tables import power
from dpl.fem import Load
from dpl.inference import Simulator

OPTIONS = (  # of calls of the simulator
    {"error": 1e-3}, {"tol": 1e-3}, {"tol": 1e-6},
    *({"tol": 1e-8, "budget_ms": budget} for budget in (10.0, 20.0, 50.0, 100.0)),
)  # fmt: skip


@dataclass(frozen=True)
class CallTime:
    """Wall time of one call with one load on one thread."""

    call: str  # the call
    loads: int  # number of different loads
    p50: float  # median [ms]
    p99: float  # 99th percentile [ms]


def call_times(simulator: Simulator, load: Load, *, repeats: int = 1) -> Iterator[CallTime]:
    """Yield the wall times of the parts of a call and of calls with several options.

    Calls without a tolerance are also listed by their number of Newton steps in the modes.
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

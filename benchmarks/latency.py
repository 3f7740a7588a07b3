"""Wall times of a trained run: its prediction, the simulator with its options, moving grasps."""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.grasps import random_grasps
from dpl import evaluation
from dpl.evaluation.tables import power
from dpl.evaluation.timing import percentiles
from dpl.export import OnnxSession, export_onnx
from dpl.export.onnx_graph import missing_packages
from dpl.fem import Load
from dpl.inference import Simulator
from dpl.system.threads import one_thread

OPTIONS = (  # of calls of the simulator
    {"error": 1e-3}, {"tol": 1e-3}, {"tol": 1e-6},
    *({"tol": 1e-8, "budget_ms": budget} for budget in (10.0, 20.0, 50.0, 100.0)),
)  # fmt: skip
GRASPS, FRAMES = 4, 180  # patches, and frames in which a hand moves each to its place, 3 s at 60 Hz


@dataclass(frozen=True)
class CallTime:
    """Wall time of one call on one thread."""

    call: str  # the call
    loads: int  # number of different loads or frames
    p50: float  # median [ms]
    p99: float  # 99th percentile [ms]


def call_times(simulator: Simulator, load: Load, *, repeats: int = 1) -> Iterator[CallTime]:
    """Yield the wall times of the parts of a call and of calls with several options."""
    scene, predict = simulator.scene, simulator.surrogate.predict
    singles = load.unbatch()
    inputs: list[dict[str, Any]] = [scene.si_inputs(single) for single in singles]

    def row(name: str, call: Callable[[Any], object], loads: Sequence[Any]) -> CallTime:
        found = evaluation.latency(call, loads, repeats=repeats)
        return CallTime(name, found.loads, found.p50, found.p99)

    def evaluate(pair: Any) -> None:
        scene.problem.with_parameters(pair[0].parameters).evaluate(pair[1])

    with torch.inference_mode():
        pairs = [(single, predict(single)) for single in singles]
    yield row("prediction", predict, singles)
    yield row("residual and min det F", evaluate, pairs)
    yield row("sim(force)", lambda one: simulator(**one), inputs)
    for options in OPTIONS:
        texts = {k: power(value) if value < 1 else f"{value:g}" for k, value in options.items()}
        words = "".join(f", {name}={text}" for name, text in texts.items())
        more = [one | options for one in inputs]
        yield row(f"sim(force{words})", lambda one: simulator(**one), more)
    if scene.problem.shape[1] == 3:
        yield from _frames(simulator)
    if not missing_packages():  # last, since the export takes longest
        with tempfile.TemporaryDirectory() as folder:
            export_onnx(simulator.surrogate, path := Path(folder) / "model.onnx")
            session = OnnxSession(path)
        arrays = [{name: column.numpy() for name, column in one.items()} for one in inputs]
        yield row("prediction, ONNX graph", lambda one: session(**one), arrays)


def _frames(simulator: Simulator) -> Iterator[CallTime]:
    """Yield the wall times of the first and of the next frames of a hand that moves patches."""
    hand, times = replace(simulator.grasp, warm=True), list[list[float]]()
    with one_thread():
        for grasp in random_grasps(simulator.scene, GRASPS):
            times.append([])
            for k in range(FRAMES):
                moved = grasp.scaled((k + 1) / FRAMES)
                start = time.perf_counter()
                hand(moved.region, moved.translation, moved.rotation)
                times[-1].append(1e3 * (time.perf_counter() - start))
    every = torch.tensor(times, dtype=torch.float64)
    for name, some in (("first frame", every[:, 0]), ("next frame", every[:, 1:].flatten())):
        yield CallTime(f"grasp, {name}", len(some), *percentiles(some))

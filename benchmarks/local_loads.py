"""Loads on small areas: errors and latencies of a trained run and of its ONNX graph."""

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from dpl.evaluation import latency
from dpl.export import ExportGraph, OnnxSession, export_onnx
from dpl.export.comparison import relative_differences
from dpl.export.onnx_graph import Array, missing_packages
from dpl.fem import Load, PatchLoads, PointLoads, solve
from dpl.inference import Simulator
from dpl.models import Unrolled
from dpl.scene import Scene
from dpl.system.threads import one_thread
from dpl.training import TrainedSurrogate

DEFLECTIONS = (1e-3, 0.05)  # largest linear deflection of the local loads over L [-]
RADIUS = 0.05  # largest radius of a patch over L [-]
STREAM = (0, 14)  # random stream of the loads
FAMILIES: dict[str, Callable[..., Any]] = {
    "point force": lambda linear, **more: PointLoads(linear, count=(1, 1), **more),
    "small patch": lambda linear, **more: PatchLoads(linear, patch_radius=(0.0, RADIUS), **more),
}
RUN = "loads of the run"


@dataclass(frozen=True)
class LocalLoads:
    """Errors and latencies of one kind of loads on one thread."""

    loads: str  # name of the kind
    deflection: float | None  # largest linear deflection over L [-]; None for the loads of the run
    count: int  # number of loads with a stable equilibrium
    # linear_p50, linear_p99: percentiles of the relative error of the linear solution [-]
    linear_p50: float
    linear_p99: float
    # error_p50, error_p99: the same of the prediction, against Newton [-]
    error_p50: float
    error_p99: float
    # predict_p50, predict_p99: percentiles of the wall time of a prediction [ms]
    predict_p50: float
    predict_p99: float
    # sim_error_p50, sim_error_p99: percentiles of the relative error of `sim(force)` [-]
    sim_error_p50: float
    sim_error_p99: float
    # sim_p50, sim_p99: percentiles of the wall time of `sim(force)` [ms]
    sim_p50: float
    sim_p99: float
    # onnx_p50, onnx_p99: the same of the ONNX graph; None if its packages are missing
    onnx_p50: float | None = None
    onnx_p99: float | None = None
    # largest relative difference of graph and prediction [-]; None like these
    onnx_error: float | None = None


def measure(surrogate: TrainedSurrogate, count: int, *, repeats: int = 1) -> Iterator[LocalLoads]:
    """Yield the rows of local loads and of the loads of the run."""
    scene, simulator = surrogate.scene, Simulator(surrogate)
    session = None
    if not missing_packages():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "model.onnx"
            export_onnx(ExportGraph(surrogate), path)
            session = OnnxSession(path)
    with one_thread():
        for name, deflection, load in kinds(scene, count):
            yield _row(simulator, session, name, deflection, load, repeats)


def kinds(scene: Scene, count: int) -> Iterator[tuple[str, float | None, Load]]:
    """Yield name, deflection and `count` loads of each kind."""
    yield RUN, None, scene.loads.sample(STREAM, range(count))
    for deflection in DEFLECTIONS:
        for name, make in FAMILIES.items():
            family = make(scene.linear, deflection=deflection)
            yield name, deflection, family.sample(STREAM, range(count))


def _row(
    simulator: Simulator,
    session: OnnxSession | None,
    name: str,
    deflection: float | None,
    load: Load,
    repeats: int,
) -> LocalLoads:
    surrogate, scene = simulator.surrogate, simulator.scene
    both = [(one, solve(scene.newton, one)) for one in load.unbatch()]  # together: much memory
    singles = [one for one, solution in both if solution.converged]
    exact = torch.cat([solution.displacement for _, solution in both if solution.converged])
    with torch.inference_mode():
        found = torch.cat([surrogate.predict(one) for one in singles])
        linear = torch.cat([linear_solution(surrogate, one) for one in singles])
    solved = torch.cat([next(scene.linear.iterate(one)).displacement for one in singles])
    numbers: dict[str, float] = {
        **_percentiles("linear", relative_differences(linear.numpy(), solved.numpy())),
        **_percentiles("error", relative_differences(found.numpy(), exact.numpy())),
    }
    times = latency(surrogate.predict, singles, repeats=repeats)
    numbers |= {"predict_p50": times.p50, "predict_p99": times.p99}
    inputs: list[dict[str, Any]] = [scene.si_inputs(one) for one in singles]
    answers = torch.cat([simulator(**one).displacement for one in inputs]) / scene.length
    numbers |= _percentiles("sim_error", relative_differences(answers.numpy(), exact.numpy()))
    times = latency(lambda one: simulator(**one), inputs, repeats=repeats)
    numbers |= {"sim_p50": times.p50, "sim_p99": times.p99}
    if session is not None:
        numbers |= _graph_numbers(session, scene, inputs, found, repeats)
    return LocalLoads(name, deflection, len(singles), **numbers)


def _graph_numbers(
    session: OnnxSession,
    scene: Scene,
    inputs: list[dict[str, Any]],
    found: Tensor,
    repeats: int,
) -> dict[str, float]:
    """Return latencies of a graph and its largest difference from predictions (B, N, D) [-]."""
    arrays = [{key: part.numpy() for key, part in one.items()} for one in inputs]
    times = latency(lambda one: session(**one), arrays, repeats=repeats)
    graph = np.concatenate([session(**one) for one in arrays]) / scene.length
    difference = float(relative_differences(graph, found.numpy()).max())
    return {"onnx_p50": times.p50, "onnx_p99": times.p99, "onnx_error": difference}


def linear_solution(surrogate: TrainedSurrogate, load: Load) -> Tensor:
    """Return the linear solution that a fitted `Unrolled` uses, (1, N, D) [-]."""
    problem, net = surrogate.scene.problem, cast(Unrolled, surrogate.net)
    field = problem.prescribed.clone()[None]
    field[:, problem.free] = net.linear(load.force[:, problem.free], load.parameters)
    return field


def _percentiles(name: str, errors: Array) -> dict[str, float]:
    return {f"{name}_p{q}": float(np.percentile(errors, q)) for q in (50, 99)}

"""Loads on small areas: errors of a trained run."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from dpl.export.comparison import relative_differences
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
    """Errors of one kind of loads."""

    loads: str  # name of the kind
    deflection: float | None  # largest linear deflection over L [-]; None for the loads of the run
    count: int  # number of loads with a stable equilibrium
    # linear_p50, linear_p99: percentiles of the relative error of the linear solution [-]
    linear_p50: float
    linear_p99: float
    # error_p50, error_p99: the same of the prediction, against Newton [-]
    error_p50: float
    error_p99: float
    # sim_error_p50, sim_error_p99: the same of `sim(force)` [-]
    sim_error_p50: float
    sim_error_p99: float


def measure(surrogate: TrainedSurrogate, count: int) -> Iterator[LocalLoads]:
    """Yield the rows of local loads and of the loads of the run."""
    simulator = Simulator(surrogate)
    with one_thread():
        for name, deflection, load in kinds(surrogate.scene, count):
            yield _row(simulator, name, deflection, load)


def kinds(scene: Scene, count: int) -> Iterator[tuple[str, float | None, Load]]:
    """Yield name, deflection and `count` loads of each kind."""
    yield RUN, None, scene.loads.sample(STREAM, range(count))
    for deflection in DEFLECTIONS:
        for name, make in FAMILIES.items():
            family = make(scene.linear, deflection=deflection)
            yield name, deflection, family.sample(STREAM, range(count))


def _row(simulator: Simulator, name: str, deflection: float | None, load: Load) -> LocalLoads:
    surrogate, scene = simulator.surrogate, simulator.scene
    both = [(one, solve(scene.newton, one)) for one in load.unbatch()]  # together: much memory
    singles = [one for one, solution in both if solution.converged]
    exact = torch.cat([solution.displacement for _, solution in both if solution.converged])
    with torch.inference_mode():
        found = torch.cat([surrogate.predict(one) for one in singles])
        linear = torch.cat([linear_solution(cast(Unrolled, surrogate.net), one) for one in singles])
    solved = torch.cat([next(scene.linear.iterate(one)).displacement for one in singles])
    inputs: list[dict[str, Any]] = [scene.si_inputs(one) for one in singles]
    answers = torch.cat([simulator(**one).displacement for one in inputs]) / scene.length
    numbers: list[float] = []
    for one, known in ((linear, solved), (found, exact), (answers, exact)):
        errors = relative_differences(one.numpy(), known.numpy())
        numbers += [float(np.percentile(errors, q)) for q in (50, 99)]
    return LocalLoads(name, deflection, len(singles), *numbers)


def linear_solution(net: Unrolled, load: Load) -> Tensor:
    """Return the linear solution that a fitted model uses, (1, N, D) [-]."""
    problem = net.scene.problem
    field = problem.prescribed.clone()[None]
    field[:, problem.free] = net.linear(load.force[:, problem.free], load.parameters)
    return field

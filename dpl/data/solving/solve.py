"""One load, drawn and solved."""

import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem import Load, Status, solve
from dpl.scene import Scene
from dpl.system.threads import one_thread


class LoadKey(NamedTuple):
    """A load to solve: which one of which stream."""

    seed: tuple[int, int]
    number: int


class SolvedLoad(NamedTuple):
    """One load, solved or not; arrays and numbers only, to cross between processes.

    Attributes:
        job: Which load it is.
        point: Point of the unit cube that it stands for, see `LoadFamily`, (d,).
        force, displacement: (N, D) [-]; the displacement is an answer only if `accepted`.
        amplitude: ||f|| / ||Phi q_max|| [-].
        accepted: Whether `displacement` meets the tolerance, inverts nothing and is stable.
        residual: ||R_free|| / ||f|| [-].
        volume_ratio: min det F [-].
        load_factor: Part of the load for which an equilibrium was found [-].
        iterations: Newton iterations.
        seconds: Wall time of the solve.
        reason: Why it is rejected; empty if accepted.
    """

    job: LoadKey
    point: NDArray[np.float64]
    force: NDArray[np.float64]
    displacement: NDArray[np.float64]
    amplitude: float
    accepted: bool
    residual: float
    volume_ratio: float
    load_factor: float
    iterations: int
    seconds: float
    reason: str


def solve_load(scene: Scene, job: LoadKey, *, point: Tensor | None = None) -> SolvedLoad:
    """Return a load, solved.

    Args:
        scene: What is simulated.
        job: Which load.
        point: What it stands for, (d,), if it is not the stream's own.
    """
    load, where = _drawn(scene, job, point)
    start = time.perf_counter()
    with one_thread():
        solution = solve(scene.solver, load)
    accepted = bool(solution.stable)
    return SolvedLoad(
        job=job,
        point=where,
        force=load.force[0].numpy(),
        displacement=solution.displacement[0].numpy(),
        amplitude=_amplitude(scene, load),
        accepted=accepted,
        residual=float(solution.residual),
        volume_ratio=float(solution.volume_ratio),
        load_factor=float(solution.load_factor),
        iterations=int(solution.iterations),
        seconds=time.perf_counter() - start,
        reason="" if accepted else str(Status(int(solution.status))),
    )


def failed_load(scene: Scene, job: LoadKey, reason: str, seconds: float = 0.0) -> SolvedLoad:
    """Return a load that the machine, and not mechanics, has left without an answer."""
    load, where = _drawn(scene, job, None)
    force = load.force[0].numpy()
    return SolvedLoad(
        *(job, where, force, 0 * force, _amplitude(scene, load), False, np.nan, np.nan),
        *(0.0, 0, seconds, reason),
    )


def _amplitude(scene: Scene, load: Load) -> float:
    return float(scene.problem.acting(load.force).norm()) / scene.loads.largest_force


def _drawn(scene: Scene, job: LoadKey, point: Tensor | None) -> tuple[Load, NDArray[np.float64]]:
    points = scene.loads.points(job.seed, [job.number]) if point is None else point[None]
    return scene.loads.loads_at(points), points[0].numpy()

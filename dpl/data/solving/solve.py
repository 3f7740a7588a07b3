"""Drawing and solving a single load."""

import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpl.fem import AndersonSolver, Load, Solution, Status, solve
from dpl.fem.solvers.rotation_strain import warped_solution
from dpl.scene import Scene
from dpl.system.threads import one_thread

# Ritz value of the tangent, relative to K(0) in the rotated frames of the nodes, above which an
# equilibrium counts as stable without a factorisation [-]. It bounds the eigenvalue from above.
MIN_RITZ_VALUE = 0.1
WINDOW = 8  # iterations in which the residual has to halve; the first ones may increase it


class LoadKey(NamedTuple):
    """Identifier of a load: seed of the stream, and number of the load in the stream."""

    seed: tuple[int, int]
    number: int


class SolvedLoad(NamedTuple):
    """A load with its solution; arrays and numbers only, so that it is pickled without torch.

    Attributes:
        job: Identifier of the load.
        point: Point of the unit cube that the load is drawn from, see `LoadFamily`, (d,).
        force, displacement: (N, D) [-]; the displacement is a solution only if `accepted`.
        amplitude: ||f|| / ||Phi q_max|| [-].
        accepted: True if `displacement` meets the tolerance, has det F > 0 and is stable.
        residual: ||R_free|| / ||f|| [-].
        volume_ratio: min det F [-].
        load_factor: Fraction of the load for which an equilibrium was found [-].
        iterations: Number of iterations.
        seconds: Wall time of the solve.
        reason: Reason of the rejection; empty if accepted.
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


def solve_load(scene: Scene, job: LoadKey) -> SolvedLoad:
    """Draw and solve a load."""
    load, point = _draw(scene, job)
    start = time.perf_counter()
    with one_thread():
        solution = equilibrium(scene, load)
    accepted = bool(solution.stable)
    return SolvedLoad(
        job=job,
        point=point,
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


def equilibrium(scene: Scene, load: Load) -> Solution:
    """Return the solution of one load, by the solver of the scene where no faster one succeeds."""
    solution = _without_tangents(scene, load)
    return solve(scene.solver, load) if solution is None else solution


def _without_tangents(scene: Scene, load: Load) -> Solution | None:
    """Return the stable equilibrium that Anderson iterations find from `warped_solution`, or None.

    None also on bodies whose tangents are far from K(0) in the rotated frames of the nodes.
    """
    # The solver of the scene decides on a load whose iteration does not converge and on one whose
    # equilibrium is unstable or nearly so. Data sets therefore hold the loads that it accepts.
    newton = scene.newton
    if newton is not scene.solver or not scene.is_compact:
        return None
    linear = newton.linear_solver.with_parameters(load.parameters)
    solver, guess = AndersonSolver(newton, window=WINDOW), warped_solution(linear, load)
    *_, solution = solver.iterate(load, guess=guess)
    if not solution.converged:
        return None
    value = linear.smallest_ritz_value(solution.displacement, solution.internal)
    return solution if value > MIN_RITZ_VALUE else None


def failed_load(scene: Scene, job: LoadKey, reason: str, seconds: float = 0.0) -> SolvedLoad:
    """Return a rejected load whose solve did not end: a time-out or a dead worker."""
    load, point = _draw(scene, job)
    force, amplitude = load.force[0].numpy(), _amplitude(scene, load)
    solution = 0 * force, amplitude, False, np.nan, np.nan, 0.0, 0, seconds, reason
    return SolvedLoad(job, point, force, *solution)


def _amplitude(scene: Scene, load: Load) -> float:
    return float(scene.problem.acting(load.force).norm()) / scene.loads.largest_force


def _draw(scene: Scene, job: LoadKey) -> tuple[Load, NDArray[np.float64]]:
    """Return a load and the point of the unit cube that it is drawn from, (d,)."""
    points = scene.loads.points(job.seed, [job.number])
    return scene.loads.loads_at(points), points[0].numpy()

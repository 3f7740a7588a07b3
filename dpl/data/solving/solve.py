"""Drawing and solving a single load."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem import AndersonSolver, Load, Solution, Status, solve
from dpl.scene import Scene
from dpl.system.threads import one_thread

# prediction of the displacement (1, N, D) [-] under a load; None: there is none yet
Guess = Callable[[Load], Tensor | None]
# Ritz value of the tangent, relative to K(0) in the rotated frames of the nodes, above which an
# equilibrium counts as stable without a factorisation [-]. It bounds the eigenvalue from above.
MIN_RITZ_VALUE = 0.1


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


def solve_load(scene: Scene, job: LoadKey, guess: NDArray[np.float64] | None = None) -> SolvedLoad:
    """Draw and solve a load, if possible from a displacement near its solution, (N, D) [-]."""
    load, point = _draw(scene, job)
    start = time.perf_counter()
    with one_thread():
        solution = None if guess is None else _solve_near(scene, load, torch.from_numpy(guess))
        if solution is None:
            solution = solve(scene.solver, load)
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


def guessed(scene: Scene, job: LoadKey, guess: Guess | None) -> NDArray[np.float64] | None:
    """Return the prediction for a load, (N, D) [-]; None without one."""
    if guess is None:
        return None
    with torch.no_grad():
        found = guess(_draw(scene, job)[0])
    return None if found is None else found[0].numpy()


def _solve_near(scene: Scene, load: Load, guess: Tensor) -> Solution | None:
    """Return the stable equilibrium near a guess (N, D), found without a factorisation, or None."""
    # The solver of the scene decides on a load whose iteration does not converge and on one whose
    # equilibrium is unstable or nearly so. Data sets therefore hold the loads that it accepts.
    newton = scene.newton
    *_, solution = AndersonSolver(newton).iterate(load, guess=guess[None])
    if not solution.converged:
        return None
    linear = newton.linear_solver.with_parameters(load.parameters)
    value = linear.smallest_ritz_value(solution.displacement)
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

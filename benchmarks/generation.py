"""Cost of a sample: Newton with and without options that reduce its run time."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dpl import Scene
from dpl.fem import Load, solve, symmetries

Guess = Callable[[Load], Tensor]  # loads to displacements (B, N, D) [-]


@dataclass(frozen=True)
class Cost:
    """Cost of one method on the same loads, one at a time, on one core.

    Attributes:
        method: Name of the method.
        seconds: Median time of a sample [s].
        rate: Number of samples over the sum of their times [1/s].
        iterations, factorisations: Mean numbers per sample.
        accepted: Number of accepted samples.
    """

    method: str
    seconds: float
    rate: float
    iterations: float
    factorisations: float
    accepted: int


def costs(
    scene: Scene, loads: int, *, pool: int = 256, surrogate: Guess | None = None
) -> list[Cost]:
    """Return the cost of a sample of each method; the methods alternate on each load.

    Args:
        scene: The scene.
        loads: Number of loads that each method solves.
        pool: Number of solved loads; the nearest one is a guess.
        surrogate: A further source of guesses.
    """
    newton = scene.newton
    once = replace(newton, factor_reuse_tol=0.0)
    starts: dict[str, tuple[object, Guess | None]] = {
        "a factor for every tangent": (once, None),
        "factors reused (the generator)": (newton, None),
        "the same, from the nearest solved load": (newton, _nearest(scene, pool)),
    }
    if surrogate is not None:
        starts["the same, from the surrogate"] = (newton, surrogate)
    found: dict[str, list[tuple[float, int, int, bool]]] = {method: [] for method in starts}
    for k in range(-1, loads):  # the first one is not timed
        load = scene.loads.sample((1, 0), [max(k, 0)])
        for method, (solver, guess) in starts.items():
            start = time.perf_counter()
            (*_, answer) = solver.iterate(load, guess=guess(load) if guess else None)  # type: ignore[attr-defined]
            seconds = time.perf_counter() - start
            count = int(answer.iterations), int(answer.factorisations), bool(answer.stable)
            if k >= 0:
                found[method].append((seconds, *count))
    rows = [_cost(method, rows) for method, rows in found.items()]
    return [*rows, _images(scene, rows[1])]


def _cost(method: str, rows: list[tuple[float, int, int, bool]]) -> Cost:
    seconds, iterations, factorisations, accepted = zip(*rows, strict=True)
    return Cost(
        method,
        statistics.median(seconds),
        len(rows) / sum(seconds),
        statistics.mean(iterations),
        statistics.mean(factorisations),
        sum(accepted),
    )


def _images(scene: Scene, solved: Cost) -> Cost:
    """Return the cost of a sample if the symmetric images of each solution count too."""
    group = symmetries(scene.problem)
    field = torch.zeros(2, *scene.problem.shape, dtype=torch.float64)
    start = time.perf_counter()
    for symmetry in group[1:]:
        symmetry.image(field)
    imaging = time.perf_counter() - start
    count = len(group)
    return Cost(
        f"factors reused, {count} symmetries",
        (solved.seconds + imaging) / count,
        count / (1 / solved.rate + imaging),
        solved.iterations / count,
        solved.factorisations / count,
        solved.accepted,
    )


def _nearest(scene: Scene, pool: int) -> Guess:
    """Return a guess: the solution of the nearest of `pool` solved loads, corrected linearly.

    The distance is that of the linear solutions. The linear solution of the difference is added.
    """
    loads = scene.loads.sample((2, 0), range(pool))
    answers = [solve(scene.solver, single) for single in loads.unbatch()]
    displacement = torch.cat([answer.displacement for answer in answers])
    linear = torch.stack([scene.linear.solve(force) for force in loads.force])

    def guess(load: Load) -> Tensor:
        response = scene.linear.solve(load.force[0])
        distance = (linear - response).flatten(1).norm(dim=1)
        k = int(distance.argmin())
        return (displacement[k] + response - linear[k])[None]

    return guess

"""What a sample costs: Newton with and without what may make it faster and keeps it exact."""

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
    """Solving the same loads in one way, one at a time, on one core.

    Attributes:
        way: How.
        seconds: Median time of a sample [s].
        rate: Samples a second: their number over the sum of their times.
        iterations, factorisations: Mean numbers of a sample.
        accepted: Of how many loads the answer was accepted.
    """

    way: str
    seconds: float
    rate: float
    iterations: float
    factorisations: float
    accepted: int


def costs(
    scene: Scene, loads: int, *, pool: int = 256, surrogate: Guess | None = None
) -> list[Cost]:
    """Return what a sample costs in each way; the ways take turns on each load.

    Args:
        scene: What is simulated.
        loads: How many loads are solved in each way.
        pool: Solved loads of which the nearest one is a start.
        surrogate: Another start.
    """
    newton = scene.solver
    once = replace(newton, factor_reuse_tol=0.0)
    starts: dict[str, tuple[object, Guess | None]] = {
        "a factor for every tangent": (once, None),
        "factors reused (the generator)": (newton, None),
        "the same, from the nearest solved load": (newton, _nearest(scene, pool)),
    }
    if surrogate is not None:
        starts["the same, from the surrogate"] = (newton, surrogate)
    found: dict[str, list[tuple[float, int, int, bool]]] = {way: [] for way in starts}
    for k in range(-1, loads):  # the first one warms up
        load = scene.loads.sample((1, 0), [max(k, 0)])
        for way, (solver, guess) in starts.items():
            start = time.perf_counter()
            (*_, answer) = solver.iterate(load, guess=guess(load) if guess else None)  # type: ignore[attr-defined]
            seconds = time.perf_counter() - start
            count = int(answer.iterations), int(answer.factorisations), bool(answer.stable)
            if k >= 0:
                found[way].append((seconds, *count))
    rows = [_cost(way, rows) for way, rows in found.items()]
    return [*rows, _images(scene, rows[1])]


def _cost(way: str, rows: list[tuple[float, int, int, bool]]) -> Cost:
    seconds, iterations, factorisations, accepted = zip(*rows, strict=True)
    return Cost(
        way,
        statistics.median(seconds),
        len(rows) / sum(seconds),
        statistics.mean(iterations),
        statistics.mean(factorisations),
        sum(accepted),
    )


def _images(scene: Scene, solved: Cost) -> Cost:
    """Return the cost of a sample where each solve gives its images under the symmetries too."""
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
    """Return a guess: the answer to the nearest of `pool` solved loads, moved on linearly.

    Near is what has a near linear answer; to it the linear answer to the difference is added.
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

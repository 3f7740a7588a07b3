"""Cost of a sample: Newton with and without options that reduce its run time."""

import statistics
import time
from dataclasses import dataclass, replace

import torch

from dpl import Scene
from dpl.fem import symmetries


@dataclass(frozen=True)
class Cost:
    """Cost of one method on the same loads, one at a time, on one core."""

    method: str  # name of the method
    seconds: float  # median time of a sample [s]
    rate: float  # number of samples over the sum of their times [1/s]
    # iterations, factorisations: mean numbers per sample
    iterations: float
    factorisations: float
    accepted: int  # number of accepted samples


def costs(scene: Scene, loads: int) -> list[Cost]:
    """Return the cost of a sample of each method; the methods alternate on each load."""
    newton = scene.newton
    solvers = {
        "a factor for every tangent": replace(newton, factor_reuse_tol=0.0),
        "factors reused (the generator)": newton,
    }
    found: dict[str, list[tuple[float, int, int, bool]]] = {method: [] for method in solvers}
    for k in range(-1, loads):  # the first one is not timed
        load = scene.loads.sample((1, 0), [max(k, 0)])
        for method, solver in solvers.items():
            start = time.perf_counter()
            (*_, answer) = solver.iterate(load)
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

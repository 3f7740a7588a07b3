"""Time of the eigenmodes of K(0) against degrees of freedom."""

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from benchmarks.discretisation import BEAM
from dpl.fem import LinearSolver, NeoHookeanLn, Plane, Problem, box, eigenmodes
from dpl.fem.linear import select_backend

BEAMS = ((28, 6, 6), (40, 10, 10), (50, 10, 10), (76, 21, 21))  # nodes along each side
PAPER = (15_000, 260.0)  # degrees of freedom and time [s]: Odot, Haferssas, Cotin (2022), 2.2.2


@dataclass(frozen=True)
class ModesTime:
    """Time of the modes of one beam on one thread, medians.

    Wall times include the time in which other programs used the core. CPU times do not.

    Attributes:
        dofs: Degrees of freedom, fixed ones included.
        modes: Number of modes.
        backend: Sparse solver; empty for the paper.
        factor_s: Assembly of K(0), analysis and factorisation, wall time [s].
        modes_s: Modes with the stored factor, wall time [s]; for the paper the time of the modes.
        factor_cpu_s, modes_cpu_s: The same as CPU times [s].
    """

    dofs: int
    modes: int | None
    backend: str
    factor_s: float | None
    modes_s: float
    factor_cpu_s: float | None = None
    modes_cpu_s: float | None = None


def mode_times(
    beams: Sequence[Sequence[int]] = BEAMS, *, count: int = 5, repeats: int = 5
) -> Iterator[ModesTime]:
    """Yield the times of the paper and of clamped beams of the given numbers of nodes.

    Args:
        beams: Numbers of nodes along the three sides of each beam.
        count: Smallest number of modes.
        repeats: Number of timed repetitions after one that is not timed.
    """
    dofs, seconds = PAPER
    yield ModesTime(dofs, None, "", None, seconds)
    for nodes in beams:
        yield _modes_of_beam(nodes, count, repeats)


def _modes_of_beam(nodes: Sequence[int], count: int, repeats: int) -> ModesTime:
    problem = Problem.build(box(BEAM, list(nodes)), NeoHookeanLn(0.3), fixed=Plane(0, "min"))
    times = []
    for _ in range(1 + repeats):
        linear = LinearSolver(problem)
        factor = _timed(partial(getattr, linear, "factor"))
        modes = _timed(partial(eigenmodes, linear, count))
        times.append((*factor, *modes))
    found = len(eigenmodes(linear, count).values)
    backend = f"{select_backend('auto', problem.pattern, problem.near_null, many_rhs=True)}"
    middle = [statistics.median(column) for column in zip(*times[1:], strict=True)]
    return ModesTime(
        problem.free.numel(), found, backend, middle[0], middle[2], middle[1], middle[3]
    )


def _timed(call: Callable[[], object]) -> tuple[float, float]:
    """Return wall and CPU time of a call [s]."""
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - wall, time.process_time() - cpu

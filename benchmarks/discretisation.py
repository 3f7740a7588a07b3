"""Discretisation errors of coarse, fine and quadratic meshes against the limit of refinement."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.pareto import Cells, Discretisation
from dpl.fem import (
    BodyForce,
    Load,
    Material,
    Newton,
    Plane,
    Problem,
    Tag,
    Traction,
    box,
    propeller,
    solve,
)

BEAM = (100.0, 25.0, 25.0)  # [m]
YOUNG = 4500.0  # [Pa]
LOAD = 20.0  # traction on the end face, against z [Pa]
PUSH = 5e-3  # body force along the propeller's shaft, over E / L [-]
Build = Callable[[Material, Cells, int], tuple[Problem, Tensor, Callable[[Tensor], float]]]


@dataclass(frozen=True)
class Family:
    """A body that can be meshed with any number of cells.

    Attributes:
        build: From law, cells and degree to the body, its load over E and what is read off.
        own: Cells of the linear mesh that the paper's body has.
        linear: Cells of linear meshes.
        quadratic: Cells of quadratic ones, each finer than the one before.
        halved: Whether each of the last three quadratic meshes is twice as fine as the one before,
            so that Richardson's limit exists; else the last of them stands for it.
    """

    build: Build
    own: Cells
    linear: tuple[Cells, ...]
    quadratic: tuple[Cells, ...]
    halved: bool


def _beam(
    law: Material, cells: Cells, degree: int
) -> tuple[Problem, Tensor, Callable[[Tensor], float]]:
    mesh = box(BEAM, [n + 1 for n in cells])
    problem = Problem.build(mesh, law, fixed=Plane(0, "min"), degree=degree)
    force = Traction(Plane(0, "max"), [0.0, 0.0, -LOAD / YOUNG]).on(problem)
    corner = (problem.points - problem.points.amax(dim=0)).norm(dim=1).argmin()
    return problem, force, lambda u: BEAM[0] * float(u[corner, 2])


def _propeller(
    law: Material, cells: Cells, degree: int
) -> tuple[Problem, Tensor, Callable[[Tensor], float]]:
    problem = Problem.build(propeller(cells=cells), law, fixed=Tag("bore"), degree=degree)
    force = BodyForce([PUSH / problem.length, 0.0, 0.0]).on(problem)
    weights = force / force.sum()
    return problem, force, lambda u: float((weights * u).sum())


FAMILIES = {
    "beam": Family(
        _beam,
        (39, 9, 9),
        ((4, 1, 1), (8, 2, 2), (16, 4, 4), (26, 6, 6), (39, 9, 9), (60, 14, 14)),
        ((4, 1, 1), (8, 2, 2), (16, 4, 4)),
        halved=True,
    ),
    "propeller": Family(
        _propeller,
        (3, 2, 2, 6, 25),
        ((1, 1, 1, 2, 8), (2, 1, 1, 4, 16), (3, 2, 2, 6, 25), (4, 3, 3, 8, 33)),
        ((1, 1, 1, 2, 8), (1, 1, 1, 3, 12), (2, 1, 1, 4, 16), (3, 2, 2, 6, 25)),
        halved=False,
    ),
}


def discretisations(family: Family, law: Material, *, repeats: int = 5) -> list[Discretisation]:
    """Return the discretisation errors of linear, then of quadratic meshes of a body.

    The limit is Richardson's of the last three quadratic meshes where each is twice as fine as the
    one before (Roache 1998, Verification and Validation in Computational Science, section 5.4);
    else it is the finest of them, which then has no row.

    Args:
        family: The body.
        law: Its material.
        repeats: Timed solves.
    """
    found = []
    for degree, meshes in ((1, family.linear), (2, family.quadratic)):
        for cells in meshes:
            problem, force, read = family.build(law, cells, degree)
            load = Load(force[None], torch.ones(1, dtype=torch.float64))
            newton = Newton(problem, tol=1e-6)
            value = read(solve(newton, load).displacement[0])
            times = [float(solve(newton, load).seconds) for _ in range(repeats)]
            ms = 1e3 * statistics.median(times)
            found.append((cells, degree, problem.free.numel(), ms, value))
    last = [value for _, degree, _, _, value in found if degree == 2][-3:]
    end = limit(*last) if family.halved else last[-1]
    rows = [Discretisation(*row, abs(row[-1] / end - 1)) for row in found]
    return [row for row in rows if row.error > 0]


def limit(coarse: float, middle: float, fine: float) -> float:
    """Return the Richardson limit of values on three meshes, each twice as fine as the last."""
    return fine + (fine - middle) ** 2 / ((middle - coarse) - (fine - middle))

"""Discretisation errors of coarse, fine and quadratic meshes against the limit of refinement."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.verification.bodies import paper_beam
from dpl import fem

BEAM = (100.0, 25.0, 25.0)  # [m]
YOUNG = 4500.0  # [Pa]
LOAD = 20.0  # traction on the end face, against z [Pa]
PUSH = 5e-3  # body force along the propeller's shaft, over E / L [-]
Cells = tuple[int, ...]
Build = Callable[[fem.Material, Cells, int], tuple[fem.Problem, Tensor, Callable[[Tensor], float]]]


@dataclass(frozen=True)
class Discretisation:
    """A mesh of a refinement study, all under the same load."""

    cells: Cells  # cells along the edges of the beam, or as `dpl.fem.propeller` counts them
    degree: int  # polynomial degree of the elements
    dofs: int  # degrees of freedom with fixed ones
    ms: float  # median wall time of Newton to a relative residual of 1e-6 [ms]
    # quantity of interest: transverse displacement at a corner of the end face of the beam [m], or
    # mean displacement of the propeller along its shaft over L [-]
    value: float
    error: float  # error of the value relative to its limit under refinement [-]


@dataclass(frozen=True)
class Family:
    """A body that can be meshed with any number of cells."""

    build: Build  # from law, cells and degree to the body, its load over E and what is read off
    own: Cells  # cells of the linear mesh that the paper's body has
    linear: tuple[Cells, ...]  # cells of linear meshes
    quadratic: tuple[Cells, ...]  # cells of quadratic ones, each finer than the one before
    # whether each of the last three quadratic meshes is twice as fine as the one before, so that
    # Richardson's limit exists; else the last of them stands for it
    halved: bool


def _beam(
    law: fem.Material, cells: Cells, degree: int
) -> tuple[fem.Problem, Tensor, Callable[[Tensor], float]]:
    problem = paper_beam(law, cells, degree=degree)
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -LOAD / YOUNG]).on(problem)
    corner = (problem.points - problem.points.amax(dim=0)).norm(dim=1).argmin()
    return problem, force, lambda u: BEAM[0] * float(u[corner, 2])


def _propeller(
    law: fem.Material, cells: Cells, degree: int
) -> tuple[fem.Problem, Tensor, Callable[[Tensor], float]]:
    problem = fem.Problem.build(
        fem.propeller(cells=cells), law, fixed=fem.Tag("bore"), degree=degree
    )
    force = fem.BodyForce([PUSH / problem.length, 0.0, 0.0]).on(problem)
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


def discretisations(family: Family, law: fem.Material, *, repeats: int = 5) -> list[Discretisation]:
    """Return the discretisation errors of linear, then of quadratic meshes of a body.

    The limit is Richardson's of the last three quadratic meshes where each is twice as fine as the
    one before (Roache 1998, Verification and Validation in Computational Science, section 5.4);
    else it is the finest of them, which then has no row.
    """
    found = []
    for degree, meshes in ((1, family.linear), (2, family.quadratic)):
        for cells in meshes:
            problem, force, read = family.build(law, cells, degree)
            load = fem.Load(force[None], torch.ones(1, dtype=torch.float64))
            newton = fem.Newton(problem, tol=1e-6)
            value = read(fem.solve(newton, load).displacement[0])
            times = [float(fem.solve(newton, load).seconds) for _ in range(repeats)]
            ms = 1e3 * statistics.median(times)
            found.append((cells, degree, problem.free.numel(), ms, value))
    last = [value for _, degree, _, _, value in found if degree == 2][-3:]
    end = limit(*last) if family.halved else last[-1]
    rows = [Discretisation(*row, abs(row[-1] / end - 1)) for row in found]
    return [row for row in rows if row.error > 0]


def limit(coarse: float, middle: float, fine: float) -> float:
    """Return the Richardson limit of values on three meshes, each twice as fine as the last."""
    return fine + (fine - middle) ** 2 / ((middle - coarse) - (fine - middle))

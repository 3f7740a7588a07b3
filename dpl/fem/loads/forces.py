"""Loads spread over a body or its boundary, as consistent nodal forces.

What holds the body (clamps, springs) is in `dpl.fem.assembly.boundary_conditions`.
"""

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from torch import Tensor

from dpl.fem.mesh.regions import Region, facets_in
from dpl.fem.options import check_options, option
from dpl.fem.problem import Problem
from dpl.fem.units import vector

ROUNDOFF = 1e-14  # nodal value over the largest that is zero [-]
Field = Callable[[NDArray[np.float64]], NDArray[np.float64]]  # (D, ...) -> (D, ...)


@dataclass(frozen=True)
class Traction:
    """Dead force per rest area on a part of the boundary, the paper's h.

    Attributes:
        region: Where.
        value: Force per area [Pa], D numbers. On a problem with E = 1 Pa, the default of
            `Problem.build`, this is the force per area over E.
    """

    region: Region
    value: Sequence[float]

    def on(self, problem: Problem) -> Tensor:
        """Return the nodal forces (N, D) over E L^(D - 1) [-]."""
        value = vector("value", self.value, problem.shape[1], "Pa")
        stress = problem.units.stress(value, f"value = {list(self.value)}")
        return traction(problem, self.region, lambda _: stress[:, None, None], problem.length)


@dataclass(frozen=True)
class BodyForce:
    """Dead force per rest volume everywhere, the paper's f, for example weight.

    It is given either by `value`, or by `acceleration` and `density`.

    Attributes:
        value: Force per volume [N/m^3], D numbers. On a problem with E = 1 Pa, the default of
            `Problem.build`, this is the force per volume over E [1/m].
        acceleration: Acceleration [m/s^2], D numbers.
        density: Mass per rest volume [kg/m^3].
    """

    value: Sequence[float] | None = None
    _: KW_ONLY
    acceleration: Sequence[float] | None = None
    density: float | None = option("kg/m^3", default=None, above=0.0)

    def __post_init__(self) -> None:
        remedy = "give value [N/m^3] alone, or acceleration [m/s^2] and density [kg/m^3]"
        for name in ("acceleration", "density"):
            given = getattr(self, name)
            if (given is None) == (self.value is None):
                condition = "be given" if given is None else "be left out where value is given"
                raise ValueError(f"{name} = {given} must {condition}; {remedy}")
        check_options(self)

    def on(self, problem: Problem) -> Tensor:
        """Return the nodal forces (N, D) over E L^(D - 1) [-]."""
        dim = problem.shape[1]
        if self.value is not None:
            words = f"value = {list(self.value)}"
            density = vector("value", self.value, dim, "N/m^3")
        else:
            assert self.acceleration is not None
            assert self.density is not None
            words = f"acceleration = {list(self.acceleration)} times density = {self.density}"
            density = self.density * vector("acceleration", self.acceleration, dim, "m/s^2")
        gradient = problem.units.stress_gradient(density, words)
        return body_force(problem, lambda _: gradient[:, None, None])


def body_force(problem: Problem, density: Field) -> Tensor:
    """Return the nodal forces (N, D) [-] of a force per rest volume.

    Args:
        problem: Where it acts.
        density: Force density times L/E [-] at dimensionless points; (D, ...) to (D, ...).
    """
    return _integral(problem, problem.basis, density)


def traction(problem: Problem, region: Region, stress: Field, scale: float = 1.0) -> Tensor:
    """Return the nodal forces (N, D) [-] of a dead traction on a part of the boundary.

    Args:
        problem: Where it acts.
        region: Which boundary facets, see `dpl.fem.mesh.facets_in`.
        stress: Traction over E [-] at dimensionless points; (D, ...) to (D, ...).
        scale: Length of which the region's coordinates are multiples [m]; 1 for a region that
            takes dimensionless points.
    """
    facets = facets_in(region, problem.mesh, scale, problem.origin)
    return _integral(problem, _facet_basis(problem, facets), stress)


def facet_areas(problem: Problem, facets: NDArray[np.int_]) -> csr_matrix:
    """Return the integrals of each shape function over each of the facets (E,), (N, E) [-]."""
    basis = _facet_basis(problem, facets)
    areas = [(np.asarray(shape[0]) * basis.dx).sum(axis=1) for shape in basis.basis]  # E each
    columns = np.tile(np.arange(len(facets)), len(areas))
    nodes = basis.element_dofs.ravel()
    matrix = csr_matrix((np.concatenate(areas), (nodes, columns)), (basis.N, len(facets)))
    matrix.data[np.abs(matrix.data) <= ROUNDOFF * matrix.data.max()] = 0.0
    matrix.eliminate_zeros()  # nodes of the cells that do not lie on the facets
    return matrix


def _facet_basis(problem: Problem, facets: NDArray[np.int_]) -> skfem.FacetBasis:
    return skfem.FacetBasis(problem.mesh, problem.basis.elem, facets=facets, intorder=4)


def _integral(problem: Problem, basis: skfem.Basis, field: Field) -> Tensor:
    """Return the integral of a field against each shape function, (N, D)."""
    # where the body lies, over L
    values = field(np.asarray(basis.global_coordinates()) + problem.origin[:, None, None])
    rows = np.broadcast_to(values, (len(values), *basis.dx.shape))
    forces = [skfem.LinearForm(lambda v, _, row=row: row * v).assemble(basis) for row in rows]
    return torch.from_numpy(np.stack(forces, axis=1))

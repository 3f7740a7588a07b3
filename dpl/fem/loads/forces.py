"""Loads spread over a body or its boundary, as consistent nodal forces.

What holds the body (clamps, springs) is in `dpl.fem.assembly.boundary_conditions`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.mesh.regions import Region, facets_in
from dpl.fem.problem import Problem

Field = Callable[[NDArray[np.float64]], NDArray[np.float64]]  # (D, ...) -> (D, ...)


@dataclass(frozen=True)
class Traction:
    """Dead force per rest area on a part of the boundary, the paper's h.

    Attributes:
        region: Where.
        value: Force per area over Young's modulus [-], D numbers.
    """

    region: Region
    value: Sequence[float]

    def on(self, problem: Problem) -> Tensor:
        """Return the nodal forces (N, D) [-].

        Raises:
            ValueError: The region holds no boundary facet, or `value` has not D numbers.
        """
        return traction(problem, self.region, _constant(problem, self.value), problem.length)


@dataclass(frozen=True)
class BodyForce:
    """Dead force per rest volume everywhere, the paper's f: weight, for one.

    Attributes:
        value: Force per volume over Young's modulus [1/m], D numbers.
    """

    value: Sequence[float]

    def on(self, problem: Problem) -> Tensor:
        """Return the nodal forces (N, D) [-].

        Raises:
            ValueError: `value` has not D numbers.
        """
        return problem.length * body_force(problem, _constant(problem, self.value))


def _constant(problem: Problem, value: Sequence[float]) -> Field:
    """Return the field that is `value` everywhere."""
    dim = problem.shape[1]
    if len(value) != dim or not np.isfinite(value).all():
        raise ValueError(f"value = {list(value)} must be {dim} finite numbers")
    return lambda x: np.multiply.outer(np.asarray(value, dtype=np.float64), np.ones(x.shape[1:]))


def body_force(problem: Problem, density: Field) -> Tensor:
    """Return the nodal forces (N, D) [-] of a force per rest volume.

    Args:
        problem: Where it acts.
        density: Force density times L/E [-] at dimensionless points; (D, ...) to (D, ...).
    """
    basis = problem.basis
    return _tested(problem, basis, density(_places(problem, basis)))


def traction(problem: Problem, region: Region, stress: Field, scale: float = 1.0) -> Tensor:
    """Return the nodal forces (N, D) [-] of a dead traction on a part of the boundary.

    Args:
        problem: Where it acts.
        region: Which boundary facets, see `dpl.fem.mesh.facets_in`.
        stress: Traction over E [-] at dimensionless points; (D, ...) to (D, ...).
        scale: Length of which the region's coordinates are multiples [m]; 1 for a region that
            takes dimensionless points.

    Raises:
        ValueError: The region holds no boundary facet.
    """
    mesh = problem.mesh
    facets = facets_in(region, mesh, scale, problem.origin)
    basis = skfem.FacetBasis(mesh, problem.basis.elem, facets=facets, intorder=4)
    return _tested(problem, basis, stress(_places(problem, basis)))


def _places(problem: Problem, basis: skfem.Basis) -> NDArray[np.float64]:
    """Return the quadrature points of a basis, (D, E, Q), where the body lies, over L."""
    return np.asarray(basis.global_coordinates()) + problem.origin[:, None, None]


def _tested(problem: Problem, basis: skfem.Basis, values: NDArray[np.float64]) -> Tensor:
    """Return the integral of values (D, E, Q) against each shape function, (N, D)."""
    dim = problem.points.shape[1]
    force = np.zeros((basis.N, dim))
    for a, dofs in enumerate(basis.element_dofs):
        shape = np.asarray(basis.basis[a][0]) * basis.dx  # (E, Q)
        np.add.at(
            force,
            dofs,
            np.einsum("deq,eq->ed", np.broadcast_to(values, (dim, *shape.shape)), shape),
        )
    return torch.from_numpy(force)

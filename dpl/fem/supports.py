"""Loads spread over a body or its boundary, as consistent nodal forces.

What holds the body (clamped regions) belongs to `dpl.fem.problem.Problem` itself.
"""

from collections.abc import Callable

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.problem import Problem

Field = Callable[[NDArray[np.float64]], NDArray[np.float64]]  # (D, ...) -> (D, ...)


def body_force(problem: Problem, density: Field) -> Tensor:
    """Return the nodal forces (N, D) [-] of a force per rest volume.

    Args:
        problem: Where it acts.
        density: Force density times L/E [-] at dimensionless points; (D, ...) to (D, ...).
    """
    basis = problem.basis
    values = density(basis.global_coordinates())  # (D, E, Q)
    return _tested(problem, basis, values)


def traction(problem: Problem, region: Field, stress: Field) -> Tensor:
    """Return the nodal forces (N, D) [-] of a dead traction on a part of the boundary.

    Args:
        problem: Where it acts.
        region: Points (N, D) [-] to bool (N,); facets with all their vertices inside are loaded.
        stress: Traction over E [-] at dimensionless points; (D, ...) to (D, ...).

    Raises:
        ValueError: The region holds no boundary facet.
    """
    mesh = problem.mesh
    inside = region(mesh.p.T)
    facets = mesh.boundary_facets()
    facets = facets[inside[mesh.facets[:, facets]].all(axis=0)]
    if not len(facets):
        raise ValueError("the region of a traction holds no boundary facet")
    basis = skfem.FacetBasis(mesh, problem.basis.elem, facets=facets, intorder=4)
    return _tested(problem, basis, stress(basis.global_coordinates()))


def _tested(problem: Problem, basis: skfem.Basis, values: NDArray[np.float64]) -> Tensor:
    """Return the integral of values (D, E, Q) against each shape function, (N, D)."""
    dim = problem.points.shape[1]
    force = np.zeros((basis.N, dim))
    for a, dofs in enumerate(basis.element_dofs):
        shape = basis.basis[a][0].value * basis.dx  # (E, Q)
        np.add.at(
            force,
            dofs,
            np.einsum("deq,eq->ed", np.broadcast_to(values, (dim, *shape.shape)), shape),
        )
    return torch.from_numpy(force)

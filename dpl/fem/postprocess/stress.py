"""Cauchy stress, von Mises stress, pressure and volume ratio at quadrature points and nodes."""

from typing import NamedTuple

import torch
from torch import Tensor

from dpl.fem.problem import Problem


class Fields(NamedTuple):
    """Nodal fields of a displacement; see `fields`.

    Attributes:
        stress: Cauchy stress over E, (B, N, 3, 3) [-].
        von_mises: Von Mises stress over E, (B, N) [-].
        pressure: -tr(stress) / 3 over E, (B, N) [-]; that of cells with mean dilatation is nearly
            constant in each.
        volume_ratio: det F, (B, N) [-].
    """

    stress: Tensor
    von_mises: Tensor
    pressure: Tensor
    volume_ratio: Tensor


def fields(problem: Problem, displacement: Tensor) -> Fields:
    """Return stress, pressure and volume ratio at the nodes under displacements (B, N, D) [-].

    A nodal value is that of a linear function, fitted to the values in the cells around the node
    (Zienkiewicz, Zhu 1992), see `dpl.fem.assembly.recovery.Recovery.build`. It is exact for values
    that are linear in the undeformed coordinates, and may lie outside the range of the values. The
    von Mises stress is that of the nodal stress, and therefore never negative. min det F of a
    solution is taken over quadrature points and differs from the smallest value at a node.
    """
    stress = problem.recovery(cauchy(problem, displacement))
    volume_ratio = torch.linalg.det(_deformation_gradient(problem, displacement))
    pressure = -stress.diagonal(dim1=-2, dim2=-1).mean(dim=-1)
    return Fields(stress, von_mises(stress), pressure, problem.recovery(volume_ratio))


def _deformation_gradient(problem: Problem, displacement: Tensor) -> Tensor:
    """Return F = I + du/dX at the quadrature points, (B, E, Q, 3, 3) [-]."""
    H = problem.discretisation.gradient(displacement)
    return H + torch.eye(3, dtype=H.dtype, device=H.device)


def cauchy(problem: Problem, displacement: Tensor) -> Tensor:
    """Return the Cauchy stress P F^T / det F over E at the quadrature points, (B, E, Q, 3, 3) [-].

    In 2D it is that of plane strain and includes the component out of the plane.
    """
    F = _deformation_gradient(problem, displacement)
    stress = problem.stress(displacement) @ F.mT
    return stress / torch.linalg.det(F)[..., None, None]


def von_mises(stress: Tensor) -> Tensor:
    """Return sqrt(3/2 s : s), shape (...), of stresses (..., 3, 3) with deviators s."""
    mean = stress.diagonal(dim1=-2, dim2=-1).mean(dim=-1)
    deviator = stress - mean[..., None, None] * torch.eye(3).to(stress)
    return (1.5 * deviator.square().sum(dim=(-2, -1))).sqrt()

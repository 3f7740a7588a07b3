"""Cauchy stress, von Mises stress and volume ratio at quadrature points and nodes."""

from typing import NamedTuple

import torch
from torch import Tensor

from dpl.fem.problem import Problem


class Fields(NamedTuple):
    """Nodal fields of a displacement; see `fields`.

    Attributes:
        stress: Cauchy stress over E, (B, N, 3, 3) [-].
        von_mises: Von Mises stress over E, (B, N) [-].
        volume_ratio: det F, (B, N) [-].
    """

    stress: Tensor
    von_mises: Tensor
    volume_ratio: Tensor


def fields(problem: Problem, displacement: Tensor) -> Fields:
    """Return stress and volume ratio at the nodes under displacements (B, N, D) [-].

    Nodal values are volume-weighted means over the adjacent cells. The von Mises stress is that of
    the nodal stress. min det F of a solution is taken over quadrature points and therefore lower.
    """
    F = deformation_gradient(problem, displacement)
    stress = at_nodes(problem, cauchy(problem, displacement))
    return Fields(stress, von_mises(stress), at_nodes(problem, torch.linalg.det(F)))


def deformation_gradient(problem: Problem, displacement: Tensor) -> Tensor:
    """Return F = I + du/dX at the quadrature points, (B, E, Q, 3, 3) [-]."""
    H = problem.gradient(displacement)
    return H + torch.eye(3, dtype=H.dtype, device=H.device)


def cauchy(problem: Problem, displacement: Tensor) -> Tensor:
    """Return the Cauchy stress P F^T / det F over E at the quadrature points, (B, E, Q, 3, 3) [-].

    In 2D it is that of plane strain and includes the component out of the plane.
    """
    F = deformation_gradient(problem, displacement)
    stress = problem.stress(displacement) @ F.mT
    return stress / torch.linalg.det(F)[..., None, None]


def von_mises(stress: Tensor) -> Tensor:
    """Return sqrt(3/2 s : s), shape (...), of stresses (..., 3, 3) with deviators s."""
    mean = stress.diagonal(dim1=-2, dim2=-1).mean(dim=-1)
    deviator = stress - mean[..., None, None] * torch.eye(3, dtype=stress.dtype).to(stress)
    return (1.5 * deviator.square().sum(dim=(-2, -1))).sqrt()


def at_nodes(problem: Problem, values: Tensor) -> Tensor:
    """Return nodal values (B, N, ...) of values at quadrature points (B, E, Q, ...).

    A nodal value is the volume-weighted mean over the adjacent cells: the lumped L2 projection of
    cell means (Zienkiewicz, Zhu 1987).
    """
    batch, count, _, *rest = values.shape
    share = problem.dV.expand(count, -1)  # (E, Q)
    integral = (values.reshape(batch, count, len(share[0]), -1) * share[..., None]).sum(dim=2)
    corners = problem.cells.shape[1]  # (B, E, components), at each node of the cell:
    spread = integral[:, :, None].expand(-1, -1, corners, -1).flatten(1, 2)
    nodes, where = problem.shape[0], problem.cells.flatten()
    total = values.new_zeros(batch, nodes, integral.shape[-1]).index_add(1, where, spread)
    volume = share.sum(dim=1)[:, None].expand(-1, corners).flatten()
    weight = values.new_zeros(nodes).index_add(0, where, volume)
    return (total / weight[:, None]).reshape(batch, nodes, *rest)

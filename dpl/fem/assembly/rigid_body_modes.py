"""Rigid body modes of a body, and those that its boundary conditions do not constrain."""

import numpy as np
import torch
from scipy.linalg import qr
from torch import Tensor

from dpl.fem.assembly.boundary_conditions import FoundationMatrix


def rigid_body_modes(points: Tensor) -> tuple[Tensor, list[str]]:
    """Return the rigid body modes of points (N, D), (N, D, 3 in 2D or 6), and their names."""
    points = points - points.mean(dim=0)
    dim = points.shape[1]
    motions, names = [], []
    for axis in range(dim):
        motions.append(torch.eye(dim, dtype=points.dtype)[axis].expand_as(points))
        names.append(f"translation along {'xyz'[axis]}")
    for i, j in [(1, 2), (0, 2), (0, 1)] if dim == 3 else [(0, 1)]:
        rotation = torch.zeros_like(points)
        rotation[:, i], rotation[:, j] = -points[:, j], points[:, i]
        motions.append(rotation)
        names.append(f"rotation about {'xyz'[3 - i - j]}")
    return torch.stack(motions, dim=-1), names


def unconstrained_modes(
    points: Tensor, free: Tensor, springs: FoundationMatrix | None
) -> list[str]:
    """Return the names of the rigid body modes that the boundary conditions do not constrain.

    Nodes (N, D), the mask of free degrees of freedom (N, D) and the foundation define the body.
    """
    motions, names = rigid_body_modes(points)
    fixed = motions[~free].numpy()  # (fixed degrees of freedom, motions)
    gram = fixed.T @ fixed
    if springs is not None:
        pull = springs.force(motions.movedim(-1, 0)).flatten(1)
        bed = (pull @ motions.flatten(0, 1)).numpy()
        gram = gram + bed / max(float(springs.stiffness.max()), 1e-300)
    if not gram.any():
        return names
    values, vectors = np.linalg.eigh(gram)
    null = vectors[:, values < 1e-14 * max(1.0, values.max())]
    if not null.size:
        return []
    _, pivots = qr(null.T, mode="r", pivoting=True)  # motions that span the null space
    return [names[k] for k in np.sort(pivots[: null.shape[1]])]

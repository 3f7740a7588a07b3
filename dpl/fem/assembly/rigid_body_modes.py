"""Rigid motions: what costs no energy, and which of it the supports of a body leave free."""

import numpy as np
import torch
from scipy.linalg import qr
from torch import Tensor

from dpl.fem.assembly.boundary_conditions import FoundationMatrix


def rigid_body_modes(points: Tensor) -> tuple[Tensor, list[str]]:
    """Return the rigid motions (N, D, 3 in 2D or 6) of points (N, D) about their centre, named."""
    points = points - points.mean(dim=0)
    dim = points.shape[1]
    motions, names = [], []
    for axis in range(dim):
        motions.append(torch.eye(dim, dtype=points.dtype)[axis].expand_as(points))
        names.append(f"translation along {'xyz'[axis]}")
    for i, j in [(1, 2), (0, 2), (0, 1)] if dim == 3 else [(0, 1)]:
        turn = torch.zeros_like(points)
        turn[:, i], turn[:, j] = -points[:, j], points[:, i]
        motions.append(turn)
        names.append(f"rotation about {'xyz'[3 - i - j]}")
    return torch.stack(motions, dim=-1), names


def unconstrained_modes(
    points: Tensor, free: Tensor, springs: FoundationMatrix | None
) -> list[str]:
    """Return the names of the rigid motions that supports leave free; none of them if held.

    Args:
        points: Of the body, (N, D).
        free: Degrees of freedom that may move, (N, D).
        springs: Those that hold it besides.
    """
    motions, names = rigid_body_modes(points)
    grip = motions[~free].numpy()  # (held, motions)
    held = grip.T @ grip
    if springs is not None:
        pull = springs.force(motions.movedim(-1, 0)).flatten(1)
        bed = (pull @ motions.flatten(0, 1)).numpy()
        held = held + bed / max(float(springs.stiffness.max()), 1e-300)
    if not held.any():
        return names
    values, vectors = np.linalg.eigh(held)
    null = vectors[:, values < 1e-14 * max(1.0, values.max())]
    if not null.size:
        return []
    _, pivots = qr(null.T, mode="r", pivoting=True)  # motions that span what is loose
    return [names[k] for k in np.sort(pivots[: null.shape[1]])]

"""Small tensor algebra on (..., 3, 3), exact where F is close to I."""

from typing import Any

import torch
from torch import Tensor


def trace(H: Tensor) -> Tensor:
    """Return tr H, (...,), of H (..., 3, 3)."""
    return H.diagonal(dim1=-2, dim2=-1).sum(-1)


def green_lagrange(H: Tensor) -> Tensor:
    """Return the Green-Lagrange strain (H + H^T + H^T H)/2, (..., 3, 3) [-]."""
    return (H + H.mT + product(H.mT, H)) / 2


def invariants(e: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return tr e, its sum of principal minors and det(I + e) - 1, (...,), of e (..., 3, 3)."""
    a, b, c, d, f, g, h, i, k = _entries(e)
    first, second = a + f + k, a * f - b * d + f * k - g * i + a * k - c * h
    third = a * (f * k - g * i) - b * (d * k - g * h) + c * (d * i - f * h)
    return first[0], second[0], (first + second + third)[0]


def _entries(F: Tensor) -> tuple[Tensor, ...]:
    """Return the nine entries of F (..., 3, 3), (1, ...) each: graphs need no further axes."""
    return F.flatten(-2).movedim(-1, 0).split(1)


def volume_change(H: Tensor) -> Tensor:
    """Return det F - 1, (...,) [-], of H = F - I (..., 3, 3), to full relative precision.

    From the invariants of H and not by `torch.linalg.det`: its second derivative at F = I is NaN.
    """
    return invariants(H)[2]


def cofactor(F: Tensor) -> Tensor:
    """Return cof F, (..., 3, 3)."""
    a, b, c, d, e, f, g, h, i = _entries(F)
    entries = [
        *(e * i - f * h, f * g - d * i, d * h - e * g),
        *(c * h - b * i, a * i - c * g, b * g - a * h),
        *(b * f - c * e, c * d - a * f, a * e - b * d),
    ]
    # components first in memory, as `Problem` lays H out: elementwise work then runs along rows
    return torch.cat(entries).movedim(0, -1).unflatten(-1, (3, 3))


def product(A: Tensor, B: Tensor) -> Tensor:
    """Return A B, (..., 3, 3), which takes less time than a batch of products of matrices."""
    a, b = (part.movedim((-2, -1), (0, 1)) for part in (A, B))
    columns, rows = a.split(1, dim=1), b.split(1)
    first, second, third = (x * y for x, y in zip(columns, rows, strict=True))
    return (first + second + third).movedim((0, 1), (-2, -1))


def inverse_transpose(H: Tensor, change: Tensor) -> Tensor:
    """Return F^-T, (..., 3, 3) [-], of F = I + H with det F = 1 + change."""
    F = H + torch.eye(3, dtype=H.dtype, device=H.device)
    return cofactor(F) / (1 + change)[..., None, None]


def dyad(A: Tensor, B: Tensor) -> Tensor:
    """Return A_ij B_kl, (..., 3, 3, 3, 3)."""
    return A[..., :, :, None, None] * B[..., None, None, :, :]


def symmetric_product(A: Tensor) -> Tensor:
    """Return (A_ik A_jl + A_il A_jk)/2, (..., 3, 3, 3, 3)."""
    product = A[..., :, None, :, None] * A[..., None, :, None, :]
    return (product + product.transpose(-1, -2)) / 2


def with_axes(values: Any, axes: int) -> Any:
    """Return values of points with `axes` trailing axes of length 1, as factors of tensors.

    A number or a tensor of shape () is returned as it is: it does not change the type of tensors.
    """
    has_axes = isinstance(values, Tensor) and values.ndim > 0
    return values[(..., *[None] * axes)] if has_axes else values

"""Size of a residual relative to loads, and the bound of its rounding error."""

from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor

from dpl.fem.assembly.discretisation import Discretisation
from dpl.fem.materials.material import Material

FAINT = 1e-292  # largest force below which arithmetic rounds to an absolute precision [-]


def relative_norm(residual: Tensor, loads: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return ||R|| over the largest of the norms of loads, and that norm, (B,) each [-].

    Norms are taken of multiples of the largest force, so that no square underflows or overflows.
    Without loads the result is ||R|| itself. It is NaN for a load that is not finite, and for one
    whose largest entry is below `FAINT`, since its residual cannot be computed.

    Args:
        residual: R, (B, n) [-].
        loads: Forces, (B, n) or (1, n) each [-].
    """
    unit = reduce(torch.maximum, [load.abs().amax(1) for load in loads])  # NaN if an entry is
    unit = torch.where(unit == 0, 1.0, unit)
    unit = torch.where((unit >= FAINT) & (unit < torch.inf), unit, torch.nan)
    size = reduce(torch.maximum, [(load / unit[:, None]).norm(dim=1) for load in loads])
    size = torch.where(size == 0, 1.0, size)
    return (residual / unit[:, None]).norm(dim=1) / size, size * unit


def relative_rounding(body: Discretisation, material: Material) -> Tensor:
    """Return a bound of the rounding error of ||R_free|| over the largest |u|, (1,) or (B,) [-].

    The bound follows from magnitudes: every nodal force is a sum of products of displacement,
    gradient, modulus and gradient. On slivers it exceeds any tolerance.
    """
    size = body.dN.norm(dim=-1)  # (E or 1, Q, A)
    terms = (body.dV[..., None] * size * size.sum(-1, keepdim=True)).sum(1)
    modulus = material.lam + 2 * material.mu
    terms = (modulus.to(terms) * terms[None])[..., None]  # (B or 1, E, A, 1)
    terms = terms.expand(-1, len(body.cells), -1, body.shape[1])
    summed = torch.where(body.free.any(dim=1), body.sum_at_nodes(terms)[..., 0], 0.0)
    return torch.finfo(torch.float64).eps * summed.norm(dim=1)

"""Size of a residual relative to loads."""

from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor

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

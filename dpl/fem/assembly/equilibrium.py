"""Criterion of equilibrium of all solvers: ||R_free|| / ||f||.

||f|| is the norm of the forces on free degrees of freedom. Forces on fixed ones do no work and
change no displacement, so they do not count. Where supports are moved, reactions do work: ||f|| is
then at least the norm of the reactions on the degrees of freedom whose prescribed displacement is
not 0. Reactions of supports that are not moved never count. Under follower loads ||f|| is at least
the norm of their nodal forces on the body at rest, a measure that does not change with the
displacement.

Source: OptiStruct 2020, Nonlinear Convergence Criteria (its relative error in loads counts "nodal
reactions due to specified displacements").
"""

from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor

FAINT = 1e-292  # largest force below which arithmetic rounds to an absolute precision [-]


def relative_norm(residual: Tensor, loads: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return ||R|| over the largest of the norms of loads, and that norm, (B,) each [-].

    R is (B, N, D), and the loads are (B or 1, N, D) [-]. Norms are taken of multiples of the
    largest force, so that no square underflows or overflows. Without loads the result is ||R||. It
    is NaN for a load that is not finite, and for one whose largest entry is below `FAINT`, since
    its residual cannot be computed.
    """
    residual, loads = residual.flatten(1), [load.flatten(1) for load in loads]
    unit = reduce(torch.maximum, [load.abs().amax(1) for load in loads])  # NaN if an entry is
    unit = torch.where(unit == 0, 1.0, unit)
    unit = torch.where((unit >= FAINT) & (unit < torch.inf), unit, torch.nan)
    size = reduce(torch.maximum, [(load / unit[:, None]).norm(dim=1) for load in loads])
    size = torch.where(size == 0, 1.0, size)
    return (residual / unit[:, None]).norm(dim=1) / size, size * unit

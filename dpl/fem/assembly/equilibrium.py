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
from scipy.linalg.blas import dnrm2
from torch import Tensor

FAINT = 1e-292  # force below which arithmetic rounds to an absolute precision [-]


def relative_norm(residual: Tensor, loads: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return ||R|| over the largest of the norms of loads, and that norm, (B,) each [-].

    R is (B, N, D), and the loads are (B or 1, N, D) [-]. Without loads the result is ||R||. It is
    NaN for a load that is not finite, and for one whose norm is below `FAINT`, since its residual
    cannot be computed.
    """
    size = reduce(torch.maximum, map(norms, loads))  # NaN if an entry is
    size = torch.where(size == 0, 1.0, size)
    size = torch.where((size >= FAINT) & (size < torch.inf), size, torch.nan)
    return norms(residual) / size, size


def norms(fields: Tensor) -> Tensor:
    """Return norms (B,) of fields (B, N, D) in float64 without under- or overflow of squares."""
    rows = fields.detach().flatten(1)
    if rows.device.type == "cpu" and not torch.compiler.is_compiling():
        return torch.tensor([dnrm2(row) for row in rows.numpy()], dtype=torch.float64)
    unit = rows.abs().amax(dim=1)
    unit = torch.where(unit > 0, unit, 1.0)
    return unit * (rows / unit[:, None]).norm(dim=1)

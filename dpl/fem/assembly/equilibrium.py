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

import numpy as np
import torch
from numba import float64, njit
from numba.types import Array, UniTuple
from scipy.linalg.blas import dnrm2
from torch import Tensor

FAINT = 1e-292  # force below which arithmetic rounds to an absolute precision [-]
SQUARES = 1e-280, 1e280  # sums of squares without under- or overflow
FIELD = Array(float64, 1, "C", readonly=True)


def relative_size(residual: Tensor, loads: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return ||R|| over the largest of the norms of loads, and that norm, (B,) each [-].

    ||R|| is (B,), and the norms are (B or 1,). Without loads the result is ||R||. It is NaN for a
    load that is not finite, and for one whose norm is below `FAINT`, since its residual cannot be
    computed.
    """
    size = reduce(torch.maximum, loads)  # NaN if an entry is
    size = size + (size == 0).double()
    size = size.masked_fill(~((size >= FAINT) & (size < torch.inf)), torch.nan)
    return residual / size, size


def difference_norms(one: Tensor, other: Tensor, factors: Tensor) -> tuple[Tensor, Tensor]:
    """Return the norms (B,) of factors (N, D) times one - other and times other, (B, N, D)."""
    if one.device.type == "cpu" and not torch.compiler.is_compiling():
        rows = (x.detach().contiguous().flatten(1).numpy() for x in (one, other))
        own = factors.flatten().numpy()
        squares = np.array([_squares(*pair, own) for pair in zip(*rows, strict=True)])
        if SQUARES[0] <= squares.min() <= squares.max() <= SQUARES[1]:  # False for NaN
            first, second = torch.from_numpy(np.sqrt(squares)).unbind(1)
            return first, second
    return norms(factors * (one - other)), norms(factors * other)


@njit([UniTuple(float64, 2)(FIELD, FIELD, FIELD)], fastmath={"reassoc", "contract"}, cache=True)
def _squares(one, other, factors):  # type: ignore[no-untyped-def]
    difference = size = 0.0
    for i in range(len(one)):
        y = factors[i] * other[i]
        x = factors[i] * one[i] - y
        difference += x * x
        size += y * y
    return difference, size


def norms(fields: Tensor) -> Tensor:
    """Return norms (B,) of fields (B, N, D) in float64 without under- or overflow of squares."""
    rows = fields.detach().flatten(1)
    if rows.device.type == "cpu" and not torch.compiler.is_compiling():
        return torch.tensor([dnrm2(row) for row in rows.numpy()], dtype=torch.float64)
    unit = rows.abs().amax(dim=1)
    unit = torch.where(unit > 0, unit, 1.0)
    return unit * (rows / unit[:, None]).norm(dim=1)

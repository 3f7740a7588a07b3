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

import math
from collections.abc import Sequence
from functools import reduce

import torch
from numba import float64, njit
from numba.types import Array, UniTuple
from scipy.linalg.blas import dnrm2
from torch import Tensor

FAINT = 1e-292  # force below which arithmetic rounds to an absolute precision [-]
SQUARES = 1e-280, 1e280  # sums of squares without under- or overflow
FIELD = Array(float64, 1, "C", readonly=True)


def relative_residual(
    internal: Tensor, force: Tensor, factors: Tensor, others: Sequence[Tensor] = ()
) -> tuple[Tensor, Tensor]:
    """Return ||R|| over the largest norm of the loads, and that norm, (B,) each [-].

    R = internal - force, (B, N, D), at degrees of freedom with a factor 1 of `factors` (N, D), not
    at those with 0. The loads are the force and others, of norms (B or 1,). Without loads the
    result is ||R||. It is NaN for a load that is not finite, and for one whose norm is below
    `FAINT`, since its residual cannot be computed.
    """
    if internal.device.type == "cpu" and not torch.compiler.is_compiling():
        own = factors.flatten().numpy()
        rows = (x.detach().contiguous().flatten(1).numpy() for x in (internal, force))
        squares = [_squares(*pair, own) for pair in zip(*rows, strict=True)]
        is_usual = all(SQUARES[0] <= x <= SQUARES[1] for pair in squares for x in pair)
        if is_usual and not others:  # no NaN, no square of a size that is too large or too small
            ratios = [math.sqrt(x / size) for x, size in squares]
            return force.new_tensor(ratios), force.new_tensor([math.sqrt(x) for _, x in squares])
    residual = norms(factors * (internal - force))
    size = reduce(torch.maximum, [norms(factors * force), *others])  # NaN if an entry is
    size = torch.where(size == 0, 1.0, size)
    size = size.masked_fill(~((size >= FAINT) & (size < torch.inf)), torch.nan)
    return residual / size, size


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

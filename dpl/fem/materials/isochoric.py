"""Derivatives of energies that are functions of isochoric invariants."""

from typing import Any

import torch
from torch import Tensor

from dpl.fem.materials.tensors import (
    green_lagrange,
    invariants,
    volume_change,
)


def polynomial_derivatives(c: Any, i1: Any, i2: Any, m1: Any, q: Any, qJ: Any) -> tuple[Any, ...]:
    """Return `invariant_derivatives` of c0 x + c1 x^2 + c2 x^3 + c3 y + U(J).

    Here x = Ib1 - 3 and y = Ib2 - 3.

    Args:
        c: Moduli.
        i1, i2, m1: As in `InvariantBasedMaterial.invariant_derivatives`.
        q, qJ: J U' and J (J U')'.
    """
    x = (1 + m1) * i1 + 3 * m1
    f1, f11 = c[0] + x * (2 * c[1] + 3 * c[2] * x), 2 * c[1] + 6 * c[2] * x
    return isochoric_derivatives(f1, f11, c[3], i1, i2, m1, q, qJ)


def isochoric_derivatives(
    f1: Any, f11: Any, f2: Any, i1: Any, i2: Any, m1: Any, q: Any, qJ: Any
) -> tuple[Any, ...]:
    """Return `invariant_derivatives` of f(x) + f2 y + U(J), x = Ib1 - 3 and y = Ib2 - 3.

    Args:
        f1, f11: f' and f''.
        f2: Factor of y.
        i1, i2, m1: As in `InvariantBasedMaterial.invariant_derivatives`.
        q, qJ: J U' and J (J U')'.
    """
    m = 1 + m1
    x = m * i1 + 3 * m1
    I1, I2 = x + 3, m * m * (3 + i2)  # of the isochoric part
    W2, W22 = f2 * m * m, 0.0
    rest = q - 2 / 3 * f1 * m * i1 - 4 / 3 * f2 * m * m * i2
    p = q - 2 / 3 * f1 * I1 - 4 / 3 * f2 * I2
    W1J = -2 / 3 * m * (f1 + f11 * I1)
    pJ = qJ + 4 / 9 * I1 * (f1 + f11 * I1) + 16 / 9 * f2 * I2
    return rest, W2, p, f11 * m * m, 0.0, W22, W1J, -4 / 3 * W2, pJ


def isochoric_invariants(H: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return Ib1 - 3, Ib2 - 3 and J - 1, (...,) [-], of H (..., 3, 3)."""
    e, j = 2 * green_lagrange(H), volume_change(H)
    i1, second, _ = invariants(e)
    log_j = torch.log1p(j)
    m, n = torch.exp(-2 / 3 * log_j), torch.exp(-4 / 3 * log_j)
    i2 = 2 * i1 + second
    return (
        m * i1 + 3 * torch.expm1(-2 / 3 * log_j),
        n * i2 + 3 * torch.expm1(-4 / 3 * log_j),
        j,
    )

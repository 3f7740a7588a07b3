"""Least-squares fit of a force by a few fixed forces, by which families recognise their loads."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LEAST_SQUARE = 1e-13  # singular value of the normal equations over the largest that counts [-]


def fit(shapes: Array, force: Array) -> tuple[Array, float]:
    """Return the coefficients (K,) and the relative residual of a least-squares fit.

    Linearly dependent shapes get the smallest coefficients. A zero force has the residual 0.

    Args:
        shapes: Fixed forces, (n, K).
        force: The force, (n,).
    """
    unit = float(np.abs(force).max(initial=0.0))
    if unit == 0:
        return np.zeros(shapes.shape[1]), 0.0
    there = force / unit
    U, sizes, Vt = np.linalg.svd(shapes.T @ shapes)
    inverse = np.where(sizes > LEAST_SQUARE * sizes[0], 1 / np.maximum(sizes, 1e-300), 0.0)
    q, rest = np.zeros(len(sizes)), there
    for _ in range(2):  # the second time removes the rounding error of the normal equations
        q = q + Vt.T @ (inverse * (U.T @ (shapes.T @ rest)))
        rest = there - shapes @ q
    return unit * q, float(np.linalg.norm(rest) / np.linalg.norm(there))

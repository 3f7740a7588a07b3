"""Least-squares fit of a force by a few fixed forces, by which families recognise their loads."""

import math
from collections.abc import Callable

import numpy as np
from numba import float64, njit
from numba.types import Array as Typed
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
SHAPES, FORCE = (Typed(float64, dim, "C", readonly=True) for dim in (3, 2))
LEAST_SQUARE = 1e-13  # singular value of the normal equations over the largest that counts [-]
EDGE = 1e-6  # of the largest size: a size that much below its range lies in it, due to rounding [-]
FITS = 1e-6  # distance from a family up to which a force belongs to it [-]


@njit([float64(SHAPES, FORCE, float64, float64[::1], float64[:, ::1], float64[::1])], cache=True)
def _add_normal_equations(shapes, force, unit, q, matrix, right):  # type: ignore[no-untyped-def]
    """Add the products of shapes (N, D, K) to `matrix`, unless empty, and with the rest to `right`.

    The rest is a force (N, D) over a unit minus the sum of q (K,) times shapes, at the nodes on
    which the force acts. Returns the square of its norm.
    """
    square = 0.0
    for n in range(len(force)):
        is_loaded = False
        for i in range(force.shape[1]):
            is_loaded = is_loaded or force[n, i] != 0
        if not is_loaded:
            continue
        for i in range(force.shape[1]):
            rest = force[n, i] / unit
            for k in range(len(q)):
                rest -= q[k] * shapes[n, i, k]
            square += rest * rest
            for k in range(len(q)):
                right[k] += rest * shapes[n, i, k]
            for k in range(len(matrix)):
                for m in range(k + 1):
                    matrix[k, m] += shapes[n, i, k] * shapes[n, i, m]
    return square


def fit(
    shapes: Array, force: Array, low: float = -np.inf, high: float = np.inf
) -> tuple[Array, float]:
    """Return the coefficients (K,) and the relative residual of a fit of shapes (N, D, K).

    The least-squares fit of a force (N, D) is over the nodes on which the force acts. If the shapes
    are linearly dependent, the coefficients with the smallest norm are returned, or coefficients in
    [low, high] of the same fit if those are not. A zero force has the residual 0.
    """
    unit, count = float(np.abs(force).max(initial=0.0)), shapes.shape[-1]
    if unit == 0:
        return np.zeros(count), 0.0
    q, (matrix, right) = np.zeros(count), (np.zeros((count, count)), np.zeros(count))
    whole = _add_normal_equations(shapes, force, unit, q, matrix, right)
    sizes, axes = np.linalg.eigh(matrix)  # which reads the lower triangle
    inverse = np.where(sizes > LEAST_SQUARE * sizes[-1], 1 / np.maximum(sizes, 1e-300), 0.0)
    for _ in range(2):  # the second time removes the rounding error of the normal equations
        q, right = q + axes @ (inverse * (right @ axes)), np.zeros(count)
        square = _add_normal_equations(shapes, force, unit, q, matrix[:0], right)
    q, residual = unit * q, math.sqrt(square / whole)
    if inverse.all() or low <= q.min() <= q.max() <= high:
        return q, residual
    from scipy.optimize import lsq_linear  # its import is not needed for independent shapes

    largest = max(-low, high) or 1.0
    root = np.sqrt(np.where(inverse > 0, sizes / max(sizes[-1], 1e-300), 0.0))[:, None] * axes.T
    wanted, bounds = root @ q / largest, (low / largest - EDGE, high / largest + EDGE)
    if (np.abs(wanted) > 2 * np.abs(root).sum(axis=1)).any():  # no such coefficients reach it
        return q, residual
    bounded = lsq_linear(root, wanted, bounds, method="bvls", tol=EDGE**2).x
    is_same = np.linalg.norm(root @ bounded - wanted) <= EDGE * np.linalg.norm(wanted)
    return (np.clip(largest * bounded, low, high) if is_same else q), residual


def project(
    shapes: Array, forces: Tensor, span: tuple[float, float], amplitude: Callable[[Array], Array]
) -> tuple[Tensor, Tensor]:
    """Return the largest amplitudes and the relative residuals of forces (B, N, D), (B,) each.

    `amplitude` maps coefficients (K,), of the range `span`, to amplitudes, (K,) or (1,).
    """
    fits = [fit(shapes, force, *span) for force in forces.numpy()]
    largest = [amplitude(coefficients).max() for coefficients, _ in fits]
    return forces.new_tensor(largest), forces.new_tensor([residual for _, residual in fits])


def amplitudes(sizes: Array, low: float, high: float, largest: float) -> Array:
    """Return |size| / largest in the range [low, high], else 1 + distance / largest, of any shape.

    The distance is that from the range. Both are equal above a range that begins at 0.
    """
    distance = np.maximum(low - sizes, sizes - high)
    return np.where(distance > EDGE * largest, 1 + distance / largest, np.abs(sizes) / largest)


def best_fit(amplitude: Array, distance: Array) -> NDArray[np.int_]:
    """Return the numbers (B,) of the best of K fits of B forces, given (K, B) each.

    It is the fit of the smallest distance, and of the smallest amplitude where several fit. An
    unknown distance, NaN, is better than any distance that does not fit.
    """
    order = np.nan_to_num(distance.clip(min=FITS), nan=2 * FITS)
    return np.asarray(np.lexsort((amplitude, order), axis=0)[0])

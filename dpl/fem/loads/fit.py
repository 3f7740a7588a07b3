"""Least-squares fit of a force by a few fixed forces, by which families recognise their loads."""

from collections.abc import Callable

import numpy as np
from numba import float64, njit
from numba.types import Array as Typed
from numba.types import Tuple
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
SHAPES, FORCE = (Typed(float64, dim, "C", readonly=True) for dim in (3, 2))
LEAST_SQUARE = 1e-13  # singular value of the normal equations over the largest that counts [-]
WELL = 1e-6  # pivot over the largest square above which shapes are independent [-]
EDGE = 1e-6  # of the largest size: a size that much below its range lies in it, due to rounding [-]
FITS = 1e-6  # distance from a family up to which a force belongs to it [-]


@njit(fastmath={"reassoc", "contract"})
def _dot(x, y):  # type: ignore[no-untyped-def]
    """Return x . y."""
    total = 0.0
    for i in range(len(x)):
        total += x[i] * y[i]
    return total


@njit([Tuple((float64[:, ::1], float64[:, ::1], float64))(SHAPES, FORCE)], cache=True)
def _loaded(shapes, force):  # type: ignore[no-untyped-def]
    """Return shapes (N, D, K) and a force (N, D) at the nodes on which the force acts, (K + 1, n).

    The force is the last row, over its largest entry. All products of the rows, (K + 1, K + 1), and
    this entry follow.
    """
    count, largest = 0, 0.0
    nodes = np.empty(len(force), np.int64)
    for n in range(len(force)):
        most = 0.0
        for i in range(force.shape[1]):
            most = max(most, abs(force[n, i]))
        if most > 0:
            nodes[count] = n
            count += 1
        largest = max(largest, most)
    K, dim = shapes.shape[2], force.shape[1]
    rows, products = np.empty((K + 1, count * dim)), np.empty((K + 1, K + 1))
    for j in range(count):
        for i in range(dim):
            for k in range(K):
                rows[k, j * dim + i] = shapes[nodes[j], i, k]
            rows[K, j * dim + i] = force[nodes[j], i] / largest
    for k in range(K + 1):
        for m in range(k + 1):
            products[k, m] = products[m, k] = _dot(rows[k], rows[m])
    return rows, products, largest


@njit([Tuple((float64[:, ::1], float64[::1]))(float64[:, :])], cache=True)
def _inverse_root(matrix):  # type: ignore[no-untyped-def]
    """Return L^-T and ones with matrix = L L^T, (K, K) and (K,); zeros if it is ill-conditioned."""
    K, largest = len(matrix), 0.0
    for j in range(K):
        largest = max(largest, matrix[j, j])
    lower, inverse, ones = np.zeros((K, K)), np.zeros((K, K)), np.ones(K)
    for j in range(K):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= lower[j, k] * lower[j, k]
        if not pivot > WELL * largest:
            return inverse, np.zeros(K)
        lower[j, j] = np.sqrt(pivot)
        for i in range(j + 1, K):
            lower[i, j] = matrix[i, j]
            for k in range(j):
                lower[i, j] -= lower[i, k] * lower[j, k]
            lower[i, j] /= lower[j, j]
    for j in range(K):  # columns of L^-1 are rows of L^-T
        for i in range(j, K):
            total = 1.0 if i == j else 0.0
            for k in range(j, i):
                total -= lower[i, k] * inverse[j, k]
            inverse[j, i] = total / lower[i, i]
    return inverse, ones


@njit(
    [Tuple((float64[::1], float64))(float64[:, ::1], *[float64[:, :]] * 2, float64[:])], cache=True
)
def _fitted(rows, products, axes, inverse):  # type: ignore[no-untyped-def]
    """Return coefficients (K,) and the relative residual of the fit of rows of `_loaded`.

    The normal equations are solved by eigenvectors and inverse eigenvalues, (K, K) and (K,).
    """
    K, size = len(axes), np.sqrt(products[-1, -1])
    q, right = np.zeros(K), products[:-1, -1].copy()
    for _ in range(2):  # the second time removes the rounding error of the normal equations
        for j in range(K):
            along = 0.0
            for k in range(K):
                along += axes[k, j] * right[k]
            for k in range(K):
                q[k] += inverse[j] * along * axes[k, j]
        rest = rows[-1].copy()
        for k in range(K):
            rest -= q[k] * rows[k]
        for k in range(K):
            right[k] = _dot(rows[k], rest)
    return q, np.sqrt(_dot(rest, rest)) / size


def fit(
    shapes: Array, force: Array, low: float = -np.inf, high: float = np.inf
) -> tuple[Array, float]:
    """Return the coefficients (K,) and the relative residual of a fit of shapes (N, D, K).

    The least-squares fit of a force (N, D) is over the nodes on which the force acts. If the shapes
    are linearly dependent, the coefficients with the smallest norm are returned, or coefficients in
    [low, high] of the same fit if those are not. A zero force has the residual 0.
    """
    rows, products, unit = _loaded(shapes, force)
    if unit == 0:
        return np.zeros(shapes.shape[-1]), 0.0
    axes, inverse = _inverse_root(products[:-1, :-1])
    if not inverse[0]:
        sizes, axes = np.linalg.eigh(products[:-1, :-1])
        inverse = np.where(sizes > LEAST_SQUARE * sizes[-1], 1 / np.maximum(sizes, 1e-300), 0.0)
    q, residual = _fitted(rows, products, axes, inverse)
    q *= unit
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

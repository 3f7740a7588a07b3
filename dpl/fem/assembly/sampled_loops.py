"""Compiled loops of one prediction of an unrolled reduced solver.

`SIMD_WIDTH` sample cells are processed at once, one per SIMD lane; H and features of a block of
cells are rows of vectors. Features and sums are float64 and matrices float32: the sums cancel
digits of the features, and the matrices are rounded before the next one is fitted.
Tests compare the loops with the tensor operations of `dpl.fem.rom.sampled_stress`.
"""

import inspect
import sys

import numpy as np
from numba import float32, float64, njit, void

from dpl.fem.assembly import constitutive_kernels as point
from dpl.fem.assembly import numba_laws, simd
from dpl.fem.assembly.simd import SIMD_WIDTH, load, store

POLAR_ITER = 5  # Newton iterations of a polar decomposition
MIN_VOLUME_RATIO = 0.05  # det F below which a sample counts as undeformed [-]
SERIES_ANGLE = 0.3  # rotation angle below which sin(t)/t - 1 is its series [rad]
SOURCES = "".join(inspect.getsource(m) for m in (simd, numba_laws, point, sys.modules[__name__]))


@njit(void(float64[::1], float32[:, ::1], float64[::1]), fastmath=True, cache=True)
def add_product(x, A, y):
    """Add x A to y, (R,), for x (F,) and A (F, R); four rows where x is zero are not read."""
    n = A.shape[1]
    i = 0
    while i + 4 <= len(x):
        a, b, c, d = x[i], x[i + 1], x[i + 2], x[i + 3]
        if a != 0.0 or b != 0.0 or c != 0.0 or d != 0.0:
            for j in range(n):
                y[j] += a * A[i, j] + b * A[i + 1, j] + c * A[i + 2, j] + d * A[i + 3, j]
        i += 4
    while i < len(x):
        for j in range(n):
            y[j] += x[i] * A[i, j]
        i += 1


@njit(error_model="numpy")
def rotated_strain(H, out):
    """Set out (9, width) to the first features of H (9, width), lane by lane."""
    for k in range(SIMD_WIDTH):
        w0 = 0.5 * (H[7, k] - H[5, k])
        w1 = 0.5 * (H[2, k] - H[6, k])
        w2 = 0.5 * (H[3, k] - H[1, k])
        square = w0 * w0 + w1 * w1 + w2 * w2
        if square < SERIES_ANGLE**2:
            s = square
            first = -s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72)))
            second = 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56 * (1 - s / 90)))
        else:
            angle = np.sqrt(square)
            first = np.sin(angle) / angle - 1.0
            second = (1.0 - np.cos(angle)) / square
        W = ((0.0, -w2, w1), (w2, 0.0, -w0), (-w1, w0, 0.0))
        w = (w0, w1, w2)
        for i in range(3):
            for j in range(3):
                total = 0.0
                for m in range(3):
                    nonlinear = w[i] * w[m] - (square if i == m else 0.0)
                    nonlinear = first * W[i][m] + second * nonlinear
                    strain = 0.5 * (H[3 * m + j, k] + H[3 * j + m, k])
                    total += (W[i][m] + nonlinear) * strain
                nonlinear = w[i] * w[j] - (square if i == j else 0.0)
                out[3 * i + j, k] = total + first * W[i][j] + second * nonlinear


@njit
def set_cofactors(X, out):
    """Set `out` (9, width) to the cofactors of X (9, width); return det X."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            minor = load(X, 3 * j + d) * load(X, 3 * k + e) - load(X, 3 * j + e) * load(
                X, 3 * k + d
            )
            store(out, 3 * i + c, minor)
    return load(X, 0) * load(out, 0) + load(X, 1) * load(out, 1) + load(X, 2) * load(out, 2)


@njit(error_model="numpy")
def unbalanced_stress(law, c, needs, finite, mu, lam, H, linear, work, out):
    """Set out (18, width) to R^T dP and dP at H (9, width); H is overwritten.

    See `dpl.fem.rom.sampled_stress.unbalanced_stress`. `work` is (100, width).
    """
    e, X, S, scratch = work[0:6], work[6:12], work[12:18], work[18:44]
    F, minors, D = work[44:53], work[53:62], work[62:98]
    store(scratch, 0, point.volume_change(H))
    for k in range(SIMD_WIDTH):
        if not scratch[0, k] > MIN_VOLUME_RATIO - 1:
            for r in range(9):
                H[r, k] = 0.0
    point.strain(H, finite, e)
    point.stress(law, c, needs, e, point.volume_change(H), X, S, scratch, D, False)
    trace = load(linear, 0) + load(linear, 4) + load(linear, 8)
    for i in range(3):
        for j in range(3):
            stress = load(S, point.VOIGT[i, j])
            for m in range(3):
                stress = stress + finite * load(H, 3 * i + m) * load(S, point.VOIGT[m, j])
            stress = stress - mu * (load(linear, 3 * i + j) + load(linear, 3 * j + i))
            if i == j:
                stress = stress - lam * trace
            store(out, 9 + 3 * i + j, stress)
            store(F, 3 * i + j, load(H, 3 * i + j) + (1.0 if i == j else 0.0))
    for _ in range(POLAR_ITER):
        half = 0.5 / set_cofactors(F, minors)
        for r in range(9):
            store(F, r, 0.5 * load(F, r) + half * load(minors, r))
    for i in range(3):
        for j in range(3):
            rotated = load(F, i) * load(out, 9 + j)
            rotated = rotated + load(F, 3 + i) * load(out, 12 + j)
            rotated = rotated + load(F, 6 + i) * load(out, 15 + j)
            store(out, 3 * i + j, rotated)


@njit
def limit_step(step, most):
    """Shorten a step (R,) to a norm of at most `most`; return its norm."""
    size = np.sqrt((step * step).sum())
    if size > most:
        step *= most / size
        return most
    return size


@njit(error_model="numpy", cache=True)
def predict(law, c, needs, finite, mu, lam, right, inverse, G, first, maps, limits, linear, whole):
    """Set coordinates (R,) of the linear solution and of the prediction.

    Args:
        law, c, needs, finite, mu, lam: The law, see `dpl.fem.assembly.kernels`.
        right: V^T f - V^T K(0) p, (R,).
        inverse: (V^T K(0) V)^-1, (R, R).
        G: Gradients of the coordinates and of p, (R + 1, blocks 9 width).
        first: B_0, (blocks 9 width, R).
        maps: B_1, ..., (K, blocks 18 width, R).
        limits: Largest ratio of each correction to the one before, (1 + K,).
        linear, whole: The results.
    """
    linear[:] = inverse @ right
    shape = (G.shape[1] // (9 * SIMD_WIDTH), 9, SIMD_WIDTH)
    rest = G[-1].astype(np.float64)
    HL = rest.copy()
    add_product(linear, G, HL)
    HL = HL.reshape(shape)
    features, work = np.zeros(HL.shape), np.zeros((100, SIMD_WIDTH))
    for b in range(shape[0]):
        rotated_strain(HL[b], features[b])
    step = np.zeros(len(linear))
    add_product(features.reshape(-1), first, step)
    size = limit_step(step, limits[0] * np.sqrt((linear * linear).sum()))
    whole[:] = linear + step
    both = np.zeros((shape[0], 18, SIMD_WIDTH))
    for k in range(maps.shape[0]):
        flat = rest.copy()
        add_product(whole, G, flat)
        H = flat.reshape(shape)
        for b in range(shape[0]):
            unbalanced_stress(law, c, needs, finite, mu, lam, H[b], HL[b], work, both[b])
        step[:] = 0.0
        add_product(both.reshape(-1), maps[k], step)
        size = limit_step(step, limits[k + 1] * size)
        whole += step

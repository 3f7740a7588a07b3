"""Compiled nonlinear strain and unbalanced stress at sample cells.

`SIMD_WIDTH` sample cells are processed at once, one per SIMD lane; H and features of a block of
cells are rows of vectors. Tests compare the loops with the tensor operations of
`dpl.models.unrolled.features`.
"""

import inspect
import sys

import numpy as np
from numba import njit

from dpl.fem.assembly import constitutive_kernels as point
from dpl.fem.assembly import numba_laws, simd
from dpl.fem.assembly.simd import SIMD_WIDTH, load, store
from dpl.fem.solvers import corotational, rotation_strain
from dpl.fem.solvers.corotational import polar_step
from dpl.fem.solvers.rotation_strain import SERIES_ANGLE

POLAR_ITER = 5  # Newton iterations of a polar decomposition
MIN_VOLUME_RATIO = 0.05  # det F below which a sample counts as undeformed [-]
MODULES = simd, numba_laws, point, corotational, rotation_strain, sys.modules[__name__]
SOURCES = "".join(inspect.getsource(module) for module in MODULES)


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


@njit(error_model="numpy")
def unbalanced_stress(law, c, finite, H, linear, work, out):
    """Set out (18, width) to R^T dP and dP at H (9, width); H is overwritten.

    See `dpl.models.unrolled.features.unbalanced_stress`. The last two constants of c (n + 2, width)
    are mu and lambda. `work` is (100, width).
    """
    e, X, S, scratch = work[0:6], work[6:12], work[12:18], work[18:44]
    F, minors, D = work[44:53], work[53:62], work[62:98]
    store(scratch, 0, point.volume_change(H))
    for k in range(SIMD_WIDTH):
        if not scratch[0, k] > MIN_VOLUME_RATIO - 1:
            for r in range(9):
                H[r, k] = 0.0
    point.strain(H, finite, e)
    point.stress(law, c, e, point.volume_change(H), X, S, D, False)
    mu, lam = load(c, c.shape[0] - 2), load(c, c.shape[0] - 1)
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
        polar_step(F, minors)
    for i in range(3):
        for j in range(3):
            rotated = load(F, i) * load(out, 9 + j)
            rotated = rotated + load(F, 3 + i) * load(out, 12 + j)
            rotated = rotated + load(F, 6 + i) * load(out, 15 + j)
            store(out, 3 * i + j, rotated)

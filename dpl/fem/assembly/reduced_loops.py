"""Compiled loop over sampled cells: change of the moduli times the gradients of a basis.

`SIMD_WIDTH` cells are processed at once, as in `dpl.fem.assembly.element_loops`.
"""

import inspect
import sys

import numpy as np
from numba import njit

from dpl.fem.assembly import constitutive_kernels as point
from dpl.fem.assembly import element_loops
from dpl.fem.assembly.lanes import (
    gather,
    gather_constants,
    gather_shape,
    gradient,
    rows,
)
from dpl.fem.assembly.simd import SIMD_WIDTH, load, store

SOURCES = element_loops.SOURCES + inspect.getsource(sys.modules[__name__])


@njit
def moduli(law, c, needs, finite, H, weight, work, A):
    """Set A (rows ((i 3 + k) 3 + J) 3 + L) to dP_iJ/dF_kL times `weight`; H becomes F."""
    e, X, S, T, scratch, D = work
    point.strain(H, finite, e)
    point.stress(law, c, needs, e, point.volume_change(H), X, S, scratch, D, True)
    for r in range(9):
        store(H, r, finite * load(H, r) + (1.0 if r % 4 == 0 else 0.0))
    point.push_forward(H, D, S, weight, finite, T, A)


@njit(error_model="numpy", cache=True)
def moduli_change_product(law, c, needs, finite, u, cells, dN, dV, basis, out):
    """Set out to dV (A(H) - A(0)) G of cells with one point each, (C, D D, R) in float32.

    H is the gradient of u (N, D), A = dP/dF, and G (C, D D, R) has the gradients of the basis,
    rows D i + J. The gradients dN are (C, 1, A, D), the volumes dV (C, 1), and the constants of the
    law (C, n), or (1, n) for all cells.
    """
    n, dim, rank = cells.shape[1], dN.shape[3], basis.shape[2]
    ue, g, weight = rows(3 * n), np.zeros((1, 3 * n, SIMD_WIDTH)), rows(1)
    H, A, rest = rows(9), rows(81), rows(81)
    work = rows(6), rows(6), rows(6), rows(6), rows(point.SCRATCH_ROWS), rows(36)
    constants = rows(c.shape[1])
    for start in range(0, len(cells), SIMD_WIDTH):
        count = min(SIMD_WIDTH, len(cells) - start)
        gather(u, cells, start, count, ue)
        gather_shape(dN, dV, start, count, g, weight)
        gather_constants(c, start, count, constants)
        H[:] = 0.0
        moduli(law, constants, needs, finite, H, load(weight, 0), work, rest)
        gradient(ue, g[0], H)
        moduli(law, constants, needs, finite, H, load(weight, 0), work, A)
        for lane in range(count):
            for i in range(dim):
                for J in range(dim):
                    row = out[start + lane, dim * i + J]
                    row[:] = 0
                    for k in range(dim):
                        for L in range(dim):
                            at = ((3 * i + k) * 3 + J) * 3 + L
                            change = np.float32(A[at, lane] - rest[at, lane])
                            other = basis[start + lane, dim * k + L]
                            for r in range(rank):
                                row[r] += change * other[r]

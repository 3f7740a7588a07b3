"""Compiled loop over sampled cells: change of the moduli times the gradients of a basis.

`SIMD_WIDTH` cells are processed at once, as in `dpl.fem.assembly.element_loops`.
"""

import inspect
import sys

import numpy as np
from numba import njit

from dpl.fem.assembly import constitutive_kernels as point
from dpl.fem.assembly import element_loops
from dpl.fem.assembly.lanes import gather_constants, rows
from dpl.fem.assembly.simd import SIMD_WIDTH, inlined, load, registers, store

SOURCES = element_loops.SOURCES + inspect.getsource(sys.modules[__name__])


@inlined
def set_moduli(law, c, needs, finite, H, A):
    """Set A (rows of `PAIR`) to dP/dF at H."""
    e, X, S, F = registers(6), registers(6), registers(6), registers(9)
    D, unit = registers(36), registers(9)
    point.strain(H, finite, e)
    point.stress(law, c, needs, e, point.volume_change(H), X, S, D, True)
    for r in range(9):
        store(unit, r, 1.0 if r % 4 == 0 else 0.0)
        store(F, r, finite * load(H, r) + load(unit, r))
    point.nominal_moduli(F, unit, 0, D, S, 1.0, finite, A, 0, 1)


@njit(error_model="numpy", cache=True)
def moduli_change_product(law, c, needs, finite, u, cells, dN, dV, basis, out):
    """Set out to dV (A(H) - A(0)) G of cells with one point each, (C, D D, R) in float32.

    H is the gradient of u (N, D), A = dP/dF, and G (C, D D, R) has the gradients of the basis,
    rows D i + J. The gradients dN are (C, 1, A, D), the volumes dV (C, 1), and the constants of the
    law (C, n), or (1, n) for all cells.
    """
    dim, rank = u.shape[1], basis.shape[2]
    H, A, rest, constants = rows(9), rows(point.PAIRS), rows(point.PAIRS), rows(c.shape[1])
    for start in range(0, len(cells), SIMD_WIDTH):
        count = min(SIMD_WIDTH, len(cells) - start)
        gather_constants(c, start, count, constants)
        H[:] = 0.0
        set_moduli(law, constants, needs, finite, H, rest)
        for lane in range(SIMD_WIDTH):
            cell = start + min(lane, count - 1)
            for a in range(cells.shape[1]):
                for i in range(dim):
                    for j in range(dim):
                        H[3 * i + j, lane] += u[cells[cell, a], i] * dN[cell, 0, a, j]
        set_moduli(law, constants, needs, finite, H, A)
        for lane in range(count):
            for i in range(dim):
                for J in range(dim):
                    row = out[start + lane, dim * i + J]
                    row[:] = 0
                    for k in range(dim):
                        for L in range(dim):
                            at = point.PAIR[3 * i + J, 3 * k + L]
                            weight = dV[start + lane, 0]
                            change = np.float32(weight * (A[at, lane] - rest[at, lane]))
                            other = basis[start + lane, dim * k + L]
                            for r in range(rank):
                                row[r] += change * other[r]

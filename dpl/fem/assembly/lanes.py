"""Cells in SIMD lanes: copies between arrays of cells and rows of vectors, in compiled loops.

`SIMD_WIDTH` cells are processed at once, one per SIMD lane.
"""

import numpy as np
from numba import njit

from dpl.fem.assembly.simd import SIMD_WIDTH, load, store


@njit
def rows(count):
    """Return a workspace of vectors, (count, SIMD_WIDTH)."""
    return np.zeros((count, SIMD_WIDTH))


@njit
def gather(field, cells, start, count, out):
    """Copy a nodal field (N, D) to rows 3 a + i of `out`, one cell per lane."""
    for lane in range(SIMD_WIDTH):
        cell = start + min(lane, count - 1)
        for a in range(cells.shape[1]):
            for i in range(field.shape[1]):
                out[3 * a + i, lane] = field[cells[cell, a], i]


@njit
def gather_constants(c, start, count, out):
    """Copy the constants of a block of cells, or other numbers, from c (E, n) to (n, SIMD_WIDTH).

    Those of all cells (1, n) are copied for the first block only.
    """
    several = c.shape[0] > 1
    if not several and start > 0:
        return
    for lane in range(SIMD_WIDTH):
        cell = start + min(lane, count - 1) if several else 0
        for k in range(c.shape[1]):
            out[k, lane] = c[cell, k]


@njit
def gather_frame(frames, q, start, count, c):
    """Copy the fibre frames of a point, from (E or 1, Q or 1, 9), to the last rows of constants c.

    What all points or cells share is copied for the first of them only.
    """
    several, points = frames.shape[0] > 1, frames.shape[1] > 1
    if (not points and q > 0) or (not several and not points and start > 0):
        return
    first = c.shape[0] - frames.shape[2]
    for lane in range(SIMD_WIDTH):
        cell = start + min(lane, count - 1) if several else 0
        for k in range(frames.shape[2]):
            c[first + k, lane] = frames[cell, q if points else 0, k]


@njit
def gather_shape(dN, dV, start, count, g, weight):
    """Copy gradients to g (Q, 3 a + j, lane) and volumes to weight (zero in unused lanes).

    Equal cells share one set. It is copied for the first block and for an incomplete block.
    """
    several = dN.shape[0] > 1
    if not several and start > 0 and count == SIMD_WIDTH:
        return
    for q in range(dN.shape[1]):
        for lane in range(SIMD_WIDTH):
            cell = start + min(lane, count - 1) if several else 0
            weight[q, lane] = dV[cell, q] if lane < count else 0.0
            for a in range(dN.shape[2]):
                for j in range(dN.shape[3]):
                    g[q, 3 * a + j, lane] = dN[cell, q, a, j]


@njit
def gradient(ue, g, H):
    """Set H (rows 3 i + j) to sum_a u_a g_a^T."""
    for i in range(3):
        u = load(ue, i)
        h0, h1, h2 = u * load(g, 0), u * load(g, 1), u * load(g, 2)
        for r in range(3, g.shape[0], 3):
            u = load(ue, r + i)
            h0 = h0 + u * load(g, r)
            h1 = h1 + u * load(g, r + 1)
            h2 = h2 + u * load(g, r + 2)
        store(H, 3 * i, h0)
        store(H, 3 * i + 1, h1)
        store(H, 3 * i + 2, h2)


@njit
def minimum(values, count, low):
    """Return the minimum of `low` and `count` values; NaN counts as -inf."""
    for lane in range(count):
        value = values[0, lane]
        low = min(low, value if value == value else -np.inf)
    return low


@njit
def scatter(fe, cells, start, count, force):
    """Add the nodal forces of a block of cells to force (N, D)."""
    for lane in range(count):
        for a in range(cells.shape[1]):
            for i in range(force.shape[1]):
                force[cells[start + lane, a], i] += fe[3 * a + i, lane]


@njit
def scatter_entries(K, places, count, values):
    """Add the entries of the matrices of a block of cells to values (nnz + 1,)."""
    for r in range(K.shape[0]):
        for lane in range(count):
            values[places[r, lane]] += K[r, lane]

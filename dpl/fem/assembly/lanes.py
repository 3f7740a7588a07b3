"""Cells in SIMD lanes, in compiled loops: nodal values, gradients and nodal forces of a block.

A block has `SIMD_WIDTH` cells, one per SIMD lane; its arrays are rows of vectors. The gradients of
the shape functions are those of the reference element times the inverse Jacobian of the cell.

The reference gradients are a table (Q, A, 3), or None for trilinear hexahedra with 2 x 2 x 2
points. A component of u is then a combination of 1, x, y, z, xy, yz, zx and xyz with
coefficients that a Hadamard transform gives, and du/dx has the same value at two points.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dpl.fem.assembly.constitutive_kernels import PAIR, PAIRS
from dpl.fem.assembly.simd import SIMD_WIDTH, choose, inlined, load, registers, store

# Nodes and points of a trilinear hexahedron by the bits of their coordinates, x + 2 y + 4 z.
NODE = np.array([7, 4, 5, 1, 6, 2, 3, 0])
POINT = np.array([0, 2, 1, 3, 4, 6, 5, 7])
GAUSS = 3**-0.5  # coordinates of the points are + and - this, those of the nodes + and - 1
SIZES = np.array([0.0, 1.0, 1.0, GAUSS, 1.0, GAUSS, GAUSS, GAUSS**2])  # of the gradients at points
SUBSETS = np.array([[0, 2, 4, 6], [0, 1, 4, 5], [0, 1, 2, 3]])  # without one of the bits
_BITS = np.arange(8)[:, None] >> np.arange(3) & 1


def _entries() -> NDArray[np.int64]:
    """Return the row of K of nodes with the bits a, b and components i, k, (3 i + k, 8 a + b)."""
    found = np.empty((3, 3, 8, 8), dtype=np.int64)
    for i, k, a, b in np.ndindex(found.shape):
        (low, first), (high, second) = sorted([(NODE[a], i), (NODE[b], k)])
        found[i, k, a, b] = 9 * (high * (high + 1) // 2 + low) + 3 * first + second
    return found.reshape(9, 64)


ENTRY = _entries()


def trilinear_gradients() -> NDArray[np.float64]:
    """Return the reference gradients of the trilinear hexahedron times 4, (8, 8, 3)."""
    nodes, points = np.empty((8, 3)), np.empty((8, 3))
    nodes[NODE], points[POINT] = 2 * _BITS - 1, GAUSS * (2 * _BITS - 1)
    factors = 1 + nodes * points[:, None]
    return nodes * factors.prod(-1, keepdims=True) / factors


@njit
def rows(count):
    """Return a workspace of vectors, (count, SIMD_WIDTH)."""
    return np.zeros((count, SIMD_WIDTH))


@inlined
def gather(field, nodes, dim, out):
    """Copy a nodal field (N, D) at nodes (A, SIMD_WIDTH) to rows 3 a + i of `out`."""
    for a in range(nodes.shape[0]):
        for lane in range(SIMD_WIDTH):
            for i in range(dim):
                out[3 * a + i, lane] = field[nodes[a, lane], i]


@njit
def gather_constants(c, start, count, out):
    """Copy the constants of a block of cells, or other numbers, from c (E or 1, n) to `out`."""
    gather_frame(c.reshape(c.shape[0], 1, c.shape[1]), 0, start, count, out[: c.shape[1]])


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


@inlined
def first_row(array, block, q):
    """Return the number of the row of a point in (blocks or 1, Q or 1, rows, SIMD_WIDTH)."""
    number = 0
    if array.shape[0] > 1:
        number = block * array.shape[1]
    if array.shape[1] > 1:
        number += q
    return number * array.shape[2]


@inlined
def slopes_of_cell(reference, ue, G):
    """Set G (rows 9 q + 3 i + d) to the reference gradients of ue (rows 3 a + i) at the points."""
    if reference is None:
        trilinear_slopes(ue, G)
        return
    total = registers(9)
    for q in range(reference.shape[0]):
        for r in range(9):
            store(total, r, 0.0)
        for a in range(reference.shape[1]):
            g0, g1, g2 = reference[q, a, 0], reference[q, a, 1], reference[q, a, 2]
            for i in range(3):
                u, r = load(ue, 3 * a + i), 3 * i
                store(total, r, load(total, r) + u * g0)
                store(total, r + 1, load(total, r + 1) + u * g1)
                store(total, r + 2, load(total, r + 2) + u * g2)
        for r in range(9):
            store(G, 9 * q + r, load(total, r))


@inlined
def gradient(G, q, inverse, first, H):
    """Set H (rows 3 i + j) to the gradient at a point, its inverse Jacobian from row `first`."""
    for i in range(3):
        g0, g1, g2 = load(G, 9 * q + 3 * i), load(G, 9 * q + 3 * i + 1), load(G, 9 * q + 3 * i + 2)
        for j in range(3):
            n0, n1 = load(inverse, first + j), load(inverse, first + 3 + j)
            store(H, 3 * i + j, g0 * n0 + g1 * n1 + g2 * load(inverse, first + 6 + j))


@inlined
def forces_of_cell(reference, P, fe):
    """Set fe (rows 3 a + i) to the nodal forces of P (rows 9 q + 3 i + d).

    P are the stresses between components and the directions of the reference element.
    """
    if reference is None:
        trilinear_forces(P, fe)
        return
    total = registers(3)
    for a in range(reference.shape[1]):
        for i in range(3):
            store(total, i, 0.0)
        for q in range(reference.shape[0]):
            g0, g1, g2 = reference[q, a, 0], reference[q, a, 1], reference[q, a, 2]
            for i in range(3):
                r = 9 * q + 3 * i
                force = load(P, r) * g0 + load(P, r + 1) * g1 + load(P, r + 2) * g2
                store(total, i, load(total, i) + force)
        for i in range(3):
            store(fe, 3 * a + i, load(total, i))


@inlined
def stiffness_of_cell(reference, A, dim, K):
    """Set K, rows (pair of nodes a <= b, i, k), to the sum over the points of the moduli A.

    The rows Q pair + q of A are those of `constitutive_kernels.nominal_moduli` between the
    directions of the reference element.
    """
    if reference is None:
        trilinear_stiffness(A, K)
        return
    C, Q = registers(27), reference.shape[0]
    for r in range(K.shape[0]):
        store(K, r, 0.0)
    for q in range(Q):
        first = 0
        for b in range(reference.shape[1]):
            g0, g1, g2 = reference[q, b, 0], reference[q, b, 1], reference[q, b, 2]
            for r in range(9):
                for k in range(3):
                    c = load(A, Q * PAIR[r, 3 * k] + q) * g0
                    c = c + load(A, Q * PAIR[r, 3 * k + 1] + q) * g1
                    c = c + load(A, Q * PAIR[r, 3 * k + 2] + q) * g2
                    store(C, 3 * r + k, c)
            for i in range(dim):
                r = 9 * i
                c0, c1, c2 = load(C, r), load(C, r + 3), load(C, r + 6)
                d0, d1, d2 = load(C, r + 1), load(C, r + 4), load(C, r + 7)
                e0, e1, e2 = load(C, r + 2), load(C, r + 5), load(C, r + 8)
                for a in range(b + 1):
                    g0, g1, g2 = reference[q, a, 0], reference[q, a, 1], reference[q, a, 2]
                    at = first + (a * dim + i) * dim
                    store(K, at, load(K, at) + g0 * c0 + g1 * c1 + g2 * c2)
                    store(K, at + 1, load(K, at + 1) + g0 * d0 + g1 * d1 + g2 * d2)
                    if dim == 3:
                        store(K, at + 2, load(K, at + 2) + g0 * e0 + g1 * e1 + g2 * e2)
            first += (b + 1) * dim * dim


@inlined
def hadamard(c, sign):
    """Replace c (8 rows) by sums over rows, minus where `sign` and a bit of both rows differ.

    With sign = 1 entry m is the sum of s_m(a) c_a; with sign = -1 entry a is the sum of
    s_m(a) c_m, the transpose. s_m(a) is the product of + 1 or - 1 for the bits of m.
    """
    for k in range(3):
        step = 1 << k
        for n in range(4):
            low = ((n >> k) << (k + 1)) + (n & (step - 1))
            p, q = load(c, low), load(c, low + step)
            if sign > 0:
                store(c, low, p + q)
                store(c, low + step, q - p)
            else:
                store(c, low, p - q)
                store(c, low + step, p + q)


@inlined
def others(d):
    """Return the bits of a direction and of the other two."""
    return 1 << d, 1 << (d + 1) % 3, 1 << (d + 2) % 3


@inlined
def trilinear_slopes(ue, H):
    """Set H to 4 times the reference gradients of ue; those along d are the same at two points."""
    c = registers(8)
    for i in range(3):
        for a in range(8):
            store(c, a, load(ue, 3 * NODE[a] + i))
        hadamard(c, 1)
        for m in range(8):
            store(c, m, load(c, m) * SIZES[m])
        for d in range(3):
            m, b, k = others(d)
            low, high = load(c, m) - load(c, m | b), load(c, m) + load(c, m | b)
            down, up = load(c, m | k) - load(c, 7), load(c, m | k) + load(c, 7)
            for end in range(2):  # of the direction
                p = end * m
                store(H, 9 * POINT[p] + 3 * i + d, low - down)
                store(H, 9 * POINT[p | b] + 3 * i + d, high - up)
                store(H, 9 * POINT[p | k] + 3 * i + d, low + down)
                store(H, 9 * POINT[p | b | k] + 3 * i + d, high + up)


@inlined
def trilinear_forces(P, fe):
    """Set fe to the transpose of `trilinear_slopes`."""
    c, s = registers(8), registers(4)
    for i in range(3):
        for m in range(8):
            store(c, m, 0.0)
        for d in range(3):
            m, b, k = others(d)
            for n in range(4):
                p = (b if n & 1 else 0) | (k if n & 2 else 0)
                r = 3 * i + d
                store(s, n, load(P, 9 * POINT[p] + r) + load(P, 9 * POINT[p | m] + r))
            low, high = load(s, 0) + load(s, 1), load(s, 2) + load(s, 3)
            down, up = load(s, 1) - load(s, 0), load(s, 3) - load(s, 2)
            store(c, m, low + high)
            store(c, m | b, load(c, m | b) + (down + up))
            store(c, m | k, load(c, m | k) + (high - low))
            store(c, 7, load(c, 7) + (up - down))
        for m in range(8):
            store(c, m, load(c, m) * SIZES[m])
        hadamard(c, -1)
        for a in range(8):
            store(fe, 3 * NODE[a] + i, load(c, a))


@inlined
def trilinear_stiffness(A, K):
    """Set K to the sum over the points, by Hadamard transforms of moduli and of both nodes."""
    c, M = registers(8), registers(64)
    for r in range(PAIRS):
        for p in range(8):
            store(c, p, load(A, 8 * r + POINT[p]))
        hadamard(c, 1)
        for p in range(8):
            store(A, 8 * r + p, load(c, p))
    for i in range(3):
        for k in range(i, 3):
            for y in range(1, 8):  # the function of the second node
                for x in range(8):
                    store(c, x, 0.0)
                for e in range(3):
                    if y >> e & 1:
                        for d in range(3):
                            at = 8 * PAIR[3 * i + d, 3 * k + e]
                            for m in range(4):
                                x, sign = SUBSETS[d, m], SUBSETS[d, m] ^ y ^ (1 << e)
                                total = load(c, x | 1 << d) + load(A, at + sign)
                                store(c, x | 1 << d, total)
                for x in range(8):
                    store(c, x, load(c, x) * (SIZES[x] * SIZES[y]))
                hadamard(c, -1)
                for a in range(8):
                    store(M, 8 * a + y, load(c, a))
            for a in range(8):
                store(c, 0, 0.0)
                for y in range(1, 8):
                    store(c, y, load(M, 8 * a + y))
                hadamard(c, -1)
                for b in range(8):
                    store(K, ENTRY[3 * i + k, 8 * a + b], load(c, b))


@inlined
def keep_minimum(x, low):
    """Set low (1, SIMD_WIDTH) to its minimum with x; NaN and infinity count as -inf."""
    finite = choose(x, np.inf, x, -np.inf)
    store(low, 0, choose(finite, load(low, 0), finite, load(low, 0)))


@inlined
def scatter(fe, nodes, count, force, dim):
    """Add the nodal forces of `count` cells of a block to force (N, D)."""
    for a in range(nodes.shape[0]):
        for lane in range(count):
            for i in range(dim):
                force[nodes[a, lane], i] += fe[3 * a + i, lane]


@inlined
def scatter_entries(K, places, values):
    """Add the entries of the matrices of a block of cells to values (nnz + SPARE,)."""
    for r in range(places.shape[0]):
        for lane in range(SIMD_WIDTH):
            values[places[r, lane]] += K[r, lane]

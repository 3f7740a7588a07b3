"""Compiled loops over the cells of a body: internal force, tangent and det F.

`SIMD_WIDTH` cells are processed at once, one per SIMD lane. The operations at a quadrature point
are in `dpl.fem.assembly.constitutive_kernels`. Tests compare the loops with the tensor operations
of `TensorAssembly`.
"""

import inspect
import sys

import numpy as np
from numba import njit

from dpl.fem.assembly import constitutive_kernels as point
from dpl.fem.assembly import numba_laws, simd
from dpl.fem.assembly.simd import SIMD_WIDTH, load, sqrt, store

SOURCES = "".join(inspect.getsource(m) for m in (simd, numba_laws, point, sys.modules[__name__]))


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
    """Copy the constants of a block of cells from c (E, n) to `out`, (n, SIMD_WIDTH).

    Constants of all cells (1, n) are copied for the first block only.
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
def add_forces(F, S, weight, g, P, fe):
    """Add the nodal forces of stress F S at a point of volume `weight` to fe (rows 3 a + i)."""
    for i in range(3):
        for j in range(3):
            stress = load(F, 3 * i) * load(S, point.VOIGT[0, j])
            stress = stress + load(F, 3 * i + 1) * load(S, point.VOIGT[1, j])
            stress = stress + load(F, 3 * i + 2) * load(S, point.VOIGT[2, j])
            store(P, 3 * i + j, weight * stress)
    for a in range(g.shape[0] // 3):
        g0, g1, g2 = load(g, 3 * a), load(g, 3 * a + 1), load(g, 3 * a + 2)
        for i in range(3):
            force = load(P, 3 * i) * g0 + load(P, 3 * i + 1) * g1 + load(P, 3 * i + 2) * g2
            store(fe, 3 * a + i, load(fe, 3 * a + i) + force)


@njit
def add_stiffness(A, g, dim, C, K):
    """Add g_a A g_b to K for all pairs of nodes a <= b, rows (pair, i, k)."""
    first = 0
    for b in range(g.shape[0] // 3):
        g0, g1, g2 = load(g, 3 * b), load(g, 3 * b + 1), load(g, 3 * b + 2)
        for r in range(27):
            store(C, r, load(A, 3 * r) * g0 + load(A, 3 * r + 1) * g1 + load(A, 3 * r + 2) * g2)
        for i in range(dim):
            r = 9 * i
            c0, c1, c2 = load(C, r), load(C, r + 1), load(C, r + 2)
            d0, d1, d2 = load(C, r + 3), load(C, r + 4), load(C, r + 5)
            e0, e1, e2 = load(C, r + 6), load(C, r + 7), load(C, r + 8)
            for a in range(b + 1):
                g0, g1, g2 = load(g, 3 * a), load(g, 3 * a + 1), load(g, 3 * a + 2)
                at = first + (a * dim + i) * dim
                store(K, at, load(K, at) + g0 * c0 + g1 * c1 + g2 * c2)
                store(K, at + 1, load(K, at + 1) + g0 * d0 + g1 * d1 + g2 * d2)
                if dim == 3:
                    store(K, at + 2, load(K, at + 2) + g0 * e0 + g1 * e1 + g2 * e2)
        first += (b + 1) * dim * dim


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


@njit
def gather_functions(psi, start, count, out):
    """Copy the functions of the volume change, (E or 1, Q, M), to out (Q, M, lane)."""
    several = psi.shape[0] > 1
    if not several and start > 0:
        return
    for lane in range(SIMD_WIDTH):
        cell = start + min(lane, count - 1) if several else 0
        for q in range(psi.shape[1]):
            for m in range(psi.shape[2]):
                out[q, m, lane] = psi[cell, q, m]


@njit
def value_of(coefficients, functions):
    """Return the value of a polynomial (M,) at a point with function values (M,)."""
    value = load(coefficients, 0) * load(functions, 0)
    for m in range(1, coefficients.shape[0]):
        value = value + load(coefficients, m) * load(functions, m)
    return value


@njit
def add_projected(value, functions, out):
    """Add a value times the functions of a point to coefficients."""
    for m in range(out.shape[0]):
        store(out, m, load(out, m) + value * load(functions, m))


@njit
def pressures_of_cells(law, c, needs, finite, points, functions, gap, work, out, count, low):
    """Set the coefficients of the pressures of a block of cells and their derivatives.

    `points` are displacements, gradients and volumes, and `functions` those of the volume change
    and the bulk modulus that stays at the points. `out` are the pressure p (M, lane) at the volume
    change of u minus `gap` (M, lane), or of u if there is none; its linear extrapolation to the
    volume change of u; and the derivative of p (M M, lane). Returns the minimum of `low` and the
    volume changes.
    """
    ue, g, weight = points
    psi, bulk = functions
    H, j, scratch = work
    p, ahead, D = out
    M, mixed = psi.shape[1], len(gap) > 0
    for part in out:
        part[:] = 0.0
    j[:] = 0.0
    for q in range(psi.shape[0]):
        gradient(ue, g[q], H)
        add_projected(load(weight, q) * point.change_of_volume(H, finite), psi[q], j)
    if mixed:
        for m in range(M):
            store(j, m, load(j, m) - load(gap, m))
    for q in range(psi.shape[0]):
        change = value_of(j, psi[q])
        store(scratch, 0, change)
        if mixed:
            low = minimum(scratch, count, low)
        pressure, modulus = point.dilatation(law, c, needs, finite, load(bulk, 0), change, scratch)
        add_projected(load(weight, q) * pressure, psi[q], p)
        if mixed:
            pressure = pressure + modulus * value_of(gap, psi[q])
        add_projected(load(weight, q) * pressure, psi[q], ahead)
        for m in range(M):
            factor = load(weight, q) * modulus * load(psi[q], m)
            add_projected(factor, psi[q], D[m * M : (m + 1) * M])
    return low


@njit
def add_slopes(F, X, J, finite, weight, psi, g, P, slopes):
    """Add the nodal forces of dJ/dF times each function of a point to slopes (M, 3 a + i)."""
    point.volume_slope(F, X, J, finite, P)
    for a in range(g.shape[0] // 3):
        g0, g1, g2 = load(g, 3 * a), load(g, 3 * a + 1), load(g, 3 * a + 2)
        for i in range(3):
            force = load(P, 3 * i) * g0 + load(P, 3 * i + 1) * g1 + load(P, 3 * i + 2) * g2
            for m in range(slopes.shape[0]):
                at = slopes[m]
                store(at, 3 * a + i, load(at, 3 * a + i) + weight * load(psi, m) * force)


@njit
def add_volumetric_stiffness(slopes, D, dim, C, K):
    """Add slopes D slopes^T to K, see `add_stiffness`."""
    M = slopes.shape[0]
    for m in range(M):
        for r in range(slopes.shape[1]):
            total = load(D, m * M) * load(slopes[0], r)
            for n in range(1, M):
                total = total + load(D, m * M + n) * load(slopes[n], r)
            store(C, r, total)
        first = 0
        for b in range(slopes.shape[1] // 3):
            for i in range(dim):
                for a in range(b + 1):
                    at = first + (a * dim + i) * dim
                    left = load(slopes[m], 3 * a + i)
                    for k in range(dim):
                        store(K, at + k, load(K, at + k) + left * load(C, 3 * b + k))
            first += (b + 1) * dim * dim


@njit(error_model="numpy", cache=True)
def add_system(
    law, c, frames, needs, finite, u, gap, cells, dN, dV, volumes, places, force, values
):
    """Add force to (N, D) and, unless empty, tangent to (nnz + 1,) at displacements u (N, D).

    The constants of the law are (E, n), or (1, n) for all cells, the fibre frames
    (E or 1, Q or 1, 9), or (1, 1, 0) for a law without fibres. `volumes` are the functions of the
    volume change of mean dilatation, (E or 1, Q, M), with M = 0 without it, and the bulk modulus
    that stays at the points, (E or 1, 1); see `dpl.fem.assembly.mean_dilatation`.

    With the gaps (blocks, Q, 6, SIMD_WIDTH) and (blocks, M, SIMD_WIDTH) stress and moduli are
    evaluated at the strain of u minus the first, and pressures at the volume change minus the
    second; both are extrapolated linearly. Returns the minimum of det F - 1, with gaps that of
    det C - 1 of the reduced strains and of the reduced volume changes.
    """
    (strain_gap, volume_gap), (psi, stays) = gap, volumes
    n, Q, dim, M = cells.shape[1], dN.shape[1], dN.shape[3], psi.shape[2]
    mixed, moduli = len(strain_gap) > 0, len(values) > 0
    ue, fe, g, weight = rows(3 * n), rows(3 * n), np.zeros((Q, 3 * n, SIMD_WIDTH)), rows(Q)
    H, P, D, A, C = rows(9), rows(9), rows(36), rows(81), rows(27)
    e, X, S, T, ahead = rows(6), rows(6), rows(6), rows(6), rows(6)
    K, low = rows(places.shape[1]), np.inf
    scratch, constants = rows(point.SCRATCH_ROWS), rows(c.shape[1] + frames.shape[2])
    functions, slopes = np.zeros((Q, M, SIMD_WIDTH)), np.zeros((M, 3 * n, SIMD_WIDTH))
    pressures, work, bulk = (rows(M), rows(M), rows(M * M)), (rows(9), rows(M), scratch), rows(1)
    no_gap, CV = rows(0), rows(3 * n)
    for start in range(0, len(cells), SIMD_WIDTH):
        block, count = start // SIMD_WIDTH, min(SIMD_WIDTH, len(cells) - start)
        gather(u, cells, start, count, ue)
        gather_shape(dN, dV, start, count, g, weight)
        gather_constants(c, start, count, constants)
        fe[:] = 0.0
        if moduli:
            K[:] = 0.0
        if M > 0:
            gather_functions(psi, start, count, functions)
            slopes[:] = 0.0
            gather_constants(stays, start, count, bulk)
            own, points = volume_gap[block] if mixed else no_gap, (ue, g, weight)
            low = pressures_of_cells(
                *(law, constants, needs, finite, points, (functions, bulk), own, work),
                *(pressures, count, low),
            )
        for q in range(Q):
            gather_frame(frames, q, start, count, constants)
            gradient(ue, g[q], H)
            point.strain(H, finite, e)
            change = point.volume_change(H)
            J = 1.0 + finite * change
            if mixed:
                change = point.reduce_strain(strain_gap[block, q], e)
            store(scratch, 0, change)
            low = minimum(scratch, count, low)
            j = change / (1.0 + sqrt(1.0 + change)) if mixed else change
            point.stress(law, constants, needs, e, j, X, S, scratch, D, moduli)
            if M > 0:
                own_j = j if finite > 0.0 else point.change_of_volume(H, finite)
                if finite == 0.0:
                    for v in range(6):
                        store(X, v, 1.0 if v < 3 else 0.0)
                pressure, modulus = point.dilatation(
                    law, constants, needs, finite, load(bulk, 0), own_j, scratch
                )
                own_J = 1.0 + finite * j
                point.add_pressure(-pressure, -modulus, own_J, X, finite, S, D, moduli)
            for v in range(6):
                store(ahead, v, load(S, v))
            if mixed:
                point.extrapolate(D, strain_gap[block, q], ahead)
            if M > 0:
                if mixed:
                    point.strain(H, finite, e)
                    point.invert(e, X)
                p, p_ahead, _ = pressures
                for pressure, own_S, own_D in ((p_ahead, ahead, False), (p, S, moduli)):
                    value = value_of(pressure, functions[q])
                    point.add_pressure(value, 0.0, J, X, finite, own_S, D, own_D)
            for r in range(9):
                store(H, r, finite * load(H, r) + (1.0 if r % 4 == 0 else 0.0))
            if moduli:
                point.push_forward(H, D, S, load(weight, q), finite, T, A)
                add_stiffness(A, g[q], dim, C, K)
                if M > 0:
                    add_slopes(H, X, J, finite, load(weight, q), functions[q], g[q], P, slopes)
            add_forces(H, ahead, load(weight, q), g[q], P, fe)
        scatter(fe, cells, start, count, force)
        if moduli:
            if M > 0:
                add_volumetric_stiffness(slopes, pressures[2], dim, CV, K)
            scatter_entries(K, places[block], count, values)
    return low


@njit(error_model="numpy", cache=True)
def update_gap(law, gap, length, update, u, cells, dN, dV, psi):
    """Return the gaps of strain and of volume after a step (N, D) to u (N, D), see `add_system`.

    They are (1 - length) gap plus what the step changes nonlinearly; that of the strain is
    length^2 dH^T dH.
    """
    strain_gap, volume_gap = gap
    n, Q, M = cells.shape[1], dN.shape[1], psi.shape[2]
    blocks = -(-len(cells) // SIMD_WIDTH)
    strains = np.zeros((blocks, Q, 6, SIMD_WIDTH))
    volumes = np.zeros((blocks, M, SIMD_WIDTH))
    ue, g, weight, H = rows(3 * n), np.zeros((Q, 3 * n, SIMD_WIDTH)), rows(Q), rows(9)
    at, deformed, functions = rows(3 * n), rows(9), np.zeros((Q, M, SIMD_WIDTH))
    for start in range(0, len(cells), SIMD_WIDTH):
        block, count = start // SIMD_WIDTH, min(SIMD_WIDTH, len(cells) - start)
        gather(update, cells, start, count, ue)
        gather_shape(dN, dV, start, count, g, weight)
        if M > 0:
            gather(u, cells, start, count, at)
            gather_functions(psi, start, count, functions)
            if len(volume_gap) > 0:
                for m in range(M):
                    store(volumes[block], m, (1.0 - length) * load(volume_gap[block], m))
        for q in range(Q):
            gradient(ue, g[q], H)
            if len(strain_gap) > 0:
                for v in range(6):
                    old = load(strain_gap[block, q], v)
                    store(strains[block, q], v, (1.0 - length) * old)
            point.quadratic(H, length * length, strains[block, q])
            if M > 0:
                gradient(at, g[q], deformed)
                for r in range(9):
                    store(H, r, length * load(H, r))
                change = point.second_volume_change(deformed, H)
                add_projected(load(weight, q) * change, functions[q], volumes[block])
    return strains, volumes

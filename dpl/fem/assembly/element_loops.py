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
from dpl.fem.assembly import lanes, numba_laws, simd, volume_loops
from dpl.fem.assembly.lanes import (
    gather,
    gather_constants,
    gather_frame,
    gather_shape,
    gradient,
    minimum,
    rows,
    scatter,
    scatter_entries,
)
from dpl.fem.assembly.simd import SIMD_WIDTH, load, sqrt, store
from dpl.fem.assembly.volume_loops import (
    add_projected,
    add_slopes,
    add_volumetric_stiffness,
    pressures_of_cells,
    value_of,
)

_MODULES = simd, lanes, numba_laws, point, volume_loops, sys.modules[__name__]
SOURCES = "".join(inspect.getsource(module) for module in _MODULES)


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


@njit(error_model="numpy", cache=True)
def add_system(
    law, c, frames, needs, finite, u, gap, cells, dN, dV, volumes, places, force, values
):
    """Add force to (N, D) and, unless empty, tangent to (nnz + 1,) at displacements u (N, D).

    The constants of the law are (E, n), or (1, n) for all cells, the fibre frames
    (E or 1, Q or 1, 9), or (1, 1, 0) for a law without fibres. `volumes` are the functions of the
    volume change of mean dilatation, (E or 1, Q, M), and the bulk modulus that stays at the points,
    (E or 1, 1), see `dpl.fem.assembly.mean_dilatation`; None without it: numba then compiles less.

    With the gaps (blocks, Q, 6, SIMD_WIDTH) and (blocks, M, SIMD_WIDTH) stress and moduli are
    evaluated at the strain of u minus the first, and pressures at the volume change minus the
    second; both are extrapolated linearly. Returns the minimum of det F - 1, with gaps that of
    det C - 1 of the reduced strains and of the reduced volume changes.
    """
    strain_gap, volume_gap = gap
    n, Q, dim = cells.shape[1], dN.shape[1], dN.shape[3]
    mixed, moduli = len(strain_gap) > 0, len(values) > 0
    ue, fe, g, weight = rows(3 * n), rows(3 * n), np.zeros((Q, 3 * n, SIMD_WIDTH)), rows(Q)
    H, P, D, A, C = rows(9), rows(9), rows(36), rows(81), rows(27)
    e, X, S, T, ahead = rows(6), rows(6), rows(6), rows(6), rows(6)
    K, low = rows(places.shape[1]), np.inf
    scratch, constants = rows(point.SCRATCH_ROWS), rows(c.shape[1] + frames.shape[2])
    if volumes is not None:
        psi, stays = volumes
        M = psi.shape[2]
        rows_of_psi = psi.reshape((len(psi), Q * M))
        functions, slopes = np.zeros((Q, M, SIMD_WIDTH)), np.zeros((M, 3 * n, SIMD_WIDTH))
        pressures, bulk = (rows(M), rows(M), rows(M * M)), rows(1)
        work, no_gap, CV = (rows(9), rows(M), scratch), rows(0), rows(3 * n)
    for start in range(0, len(cells), SIMD_WIDTH):
        block, count = start // SIMD_WIDTH, min(SIMD_WIDTH, len(cells) - start)
        gather(u, cells, start, count, ue)
        gather_shape(dN, dV, start, count, g, weight)
        gather_constants(c, start, count, constants)
        fe[:] = 0.0
        if moduli:
            K[:] = 0.0
        if volumes is not None:
            gather_constants(rows_of_psi, start, count, functions.reshape((Q * M, SIMD_WIDTH)))
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
            if volumes is not None:
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
            if volumes is not None:
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
                if volumes is not None:
                    add_slopes(H, X, J, finite, load(weight, q), functions[q], g[q], P, slopes)
            add_forces(H, ahead, load(weight, q), g[q], P, fe)
        scatter(fe, cells, start, count, force)
        if moduli:
            if volumes is not None:
                add_volumetric_stiffness(slopes, pressures[2], dim, CV, K)
            scatter_entries(K, places[block], count, values)
    return low


@njit(error_model="numpy", cache=True)
def update_gap(law, gap, length, update, u, cells, dN, dV, psi):
    """Return the gaps of strain and of volume after a step (N, D) to u (N, D), see `add_system`.

    `psi` are the functions of the volume change, (E or 1, Q, M), or None.

    They are (1 - length) gap plus what the step changes nonlinearly; that of the strain is
    length^2 dH^T dH.
    """
    strain_gap, volume_gap = gap
    n, Q = cells.shape[1], dN.shape[1]
    M = 0 if psi is None else psi.shape[2]
    if psi is not None:
        rows_of_psi = psi.reshape((len(psi), Q * M))
    blocks = -(-len(cells) // SIMD_WIDTH)
    strains = np.zeros((blocks, Q, 6, SIMD_WIDTH))
    volumes = np.zeros((blocks, M, SIMD_WIDTH))
    ue, g, weight, H = rows(3 * n), np.zeros((Q, 3 * n, SIMD_WIDTH)), rows(Q), rows(9)
    at, deformed, functions = rows(3 * n), rows(9), np.zeros((Q, M, SIMD_WIDTH))
    for start in range(0, len(cells), SIMD_WIDTH):
        block, count = start // SIMD_WIDTH, min(SIMD_WIDTH, len(cells) - start)
        gather(update, cells, start, count, ue)
        gather_shape(dN, dV, start, count, g, weight)
        if psi is not None:
            gather(u, cells, start, count, at)
            gather_constants(rows_of_psi, start, count, functions.reshape((Q * M, SIMD_WIDTH)))
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
            if psi is not None:
                gradient(at, g[q], deformed)
                for r in range(9):
                    store(H, r, length * load(H, r))
                change = point.second_volume_change(deformed, H)
                add_projected(load(weight, q) * change, functions[q], volumes[block])
    return strains, volumes

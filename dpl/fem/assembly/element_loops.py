"""Compiled loops over cells: internal force, tangent, det F, and moduli times a basis.

`SIMD_WIDTH` cells are processed at once, one per SIMD lane. The operations at a quadrature point
are in `dpl.fem.assembly.constitutive_kernels`. With mean dilatation the polynomials of the volume
change are rows of vectors (M, SIMD_WIDTH), their functions at the points (Q, M, SIMD_WIDTH). Tests
compare the loops with the tensor operations of `TensorAssembly`.
"""

import inspect
import sys

import numpy as np
from numba import njit

from dpl.fem.assembly import constitutive_kernels as point
from dpl.fem.assembly import lanes, numba_laws, simd
from dpl.fem.assembly.lanes import (
    first_row,
    forces_of_cell,
    gather,
    gather_constants,
    gather_frame,
    gradient,
    keep_minimum,
    rows,
    scatter,
    scatter_entries,
    slopes_of_cell,
    stiffness_of_cell,
)
from dpl.fem.assembly.simd import SIMD_WIDTH, inlined, load, registers, sqrt, store

_MODULES = simd, lanes, numba_laws, point, sys.modules[__name__]
SOURCES = "".join(inspect.getsource(module) for module in _MODULES)


@inlined
def value_of(coefficients, functions):
    """Return the value of a polynomial (M,) at a point with function values (M,)."""
    value = load(coefficients, 0) * load(functions, 0)
    for m in range(1, coefficients.shape[0]):
        value = value + load(coefficients, m) * load(functions, m)
    return value


@inlined
def add_projected(value, functions, out):
    """Add a value times the functions of a point to coefficients."""
    for m in range(out.shape[0]):
        store(out, m, load(out, m) + value * load(functions, m))


@inlined
def pressures_of_cells(
    law, c, finite, G, inverse, block, weights, functions, bulk, gap, j, out, low
):  # fmt: skip
    """Set the coefficients of the pressures of a block of cells and their derivatives.

    G (rows 9 q + 3 i + d) are the reference gradients of u. `functions` are those of the volume
    change, and `bulk` is the bulk modulus that stays at the points. `out` are the pressure p
    (M, lane) at the volume change of u minus `gap` (M, lane), or of u if there is none; its linear
    extrapolation to the volume change of u; and the derivative of p (M M, lane). With a gap `low`
    becomes its minimum with the volume changes.
    """
    p, ahead, D = out
    M, mixed, H = functions.shape[1], len(gap) > 0, registers(9)
    for part in out:
        part[:] = 0.0
    j[:] = 0.0
    for q in range(functions.shape[0]):
        gradient(G, q, inverse, first_row(inverse, block, q), H)
        add_projected(load(weights, q) * point.change_of_volume(H, finite), functions[q], j)
    if mixed:
        for m in range(M):
            store(j, m, load(j, m) - load(gap, m))
    for q in range(functions.shape[0]):
        change, psi, weight = value_of(j, functions[q]), functions[q], load(weights, q)
        if mixed:
            keep_minimum(change, low)
        pressure, modulus = point.dilatation(law, c, finite, load(bulk, 0), change)
        add_projected(weight * pressure, psi, p)
        if mixed:
            pressure = pressure + modulus * value_of(gap, psi)
        add_projected(weight * pressure, psi, ahead)
        for m in range(M):
            add_projected(weight * modulus * load(psi, m), psi, D[m * M : (m + 1) * M])


@inlined
def add_volumetric_stiffness(slopes, D, dim, C, K):
    """Add slopes D slopes^T to K, see `stiffness_of_cell`."""
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
    law, c, frames, finite, u, gap, cells, reference, inverse, dV, volumes, places, force,
    values,
):  # fmt: skip
    """Add force to (N, D) and, unless empty, tangent to (nnz + SPARE,) at displacements u (N, D).

    `cells` are the nodes of each cell, (blocks, A, SIMD_WIDTH), and the number of cells. The
    constants of the law are (E, n), or (1, n) for all cells, the fibre frames (E or 1, Q or 1, 9),
    or (1, 1, 0) for a law without fibres. For `reference` see `dpl.fem.assembly.lanes`. The inverse
    Jacobians are (blocks or 1, Q or 1, 9, SIMD_WIDTH), rows 3 d + j, and the volumes of the points
    (blocks or 1, Q, 1, SIMD_WIDTH). `volumes` are the functions of the volume change of mean
    dilatation, (blocks or 1, Q, M, SIMD_WIDTH), and the bulk modulus that stays at the points,
    (E or 1, 1), see `dpl.fem.assembly.mean_dilatation`; None without it: numba then compiles less.

    With the gaps (blocks, Q, 6, SIMD_WIDTH) and (blocks, M, SIMD_WIDTH) stress and moduli are
    evaluated at the strain of u minus the first, and pressures at the volume change minus the
    second; both are extrapolated linearly. Returns the minimum of det F - 1, with gaps that of
    det C - 1 of the reduced strains and of the reduced volume changes.
    """
    (numbers, n_cells), (strain_gap, volume_gap) = cells, gap
    n, Q, dim = numbers.shape[1], dV.shape[1], u.shape[1]
    mixed, moduli = len(strain_gap) > 0, len(values) > 0
    if reference is None:
        dim = 3
        ue, fe, G, P = registers(24), registers(24), registers(72), registers(72)
        A, K = registers(360), registers(324)
    else:
        ue, fe, G, P = rows(3 * n), rows(3 * n), rows(9 * Q), rows(9 * Q)
        A, K = rows(Q * point.PAIRS), rows(places.shape[1])
    H, F, T, D, low = registers(9), registers(9), registers(9), registers(36), registers(1)
    e, X, Y, S, ahead = registers(6), registers(6), registers(6), registers(6), registers(6)
    constants = rows(c.shape[1] + frames.shape[2])
    plain = not (mixed or moduli or numba_laws.has_fibres(law))
    store(low, 0, np.inf)
    if volumes is not None:
        psi, stays = volumes
        plain = False
        M = psi.shape[2]
        slopes, stresses = np.zeros((M, 3 * n, SIMD_WIDTH)), np.zeros((M, 9 * Q, SIMD_WIDTH))
        pressures, bulk = (rows(M), rows(M), rows(M * M)), rows(1)
        work, no_gap, CV = rows(M), rows(0), rows(3 * n)
    for block in range(len(numbers)):
        start = SIMD_WIDTH * block
        count = min(SIMD_WIDTH, n_cells - start)
        gather(u, numbers[block], dim, ue)
        gather_constants(c, start, count, constants)
        slopes_of_cell(reference, ue, G)
        if volumes is not None:
            gather_constants(stays, start, count, bulk)
            functions = psi[block if len(psi) > 1 else 0]
            weights = dV[block if len(dV) > 1 else 0]
            own = volume_gap[block] if mixed else no_gap
            pressures_of_cells(
                *(law, constants, finite, G, inverse, block, weights, functions, bulk),
                *(own, work, pressures, low),
            )
        for q in range(Q):
            first, weight = first_row(inverse, block, q), load(dV, first_row(dV, block, q))
            if numba_laws.has_fibres(law):
                gather_frame(frames, q, start, count, constants)
            gradient(G, q, inverse, first, H)
            change = point.volume_change(H)
            if plain:
                keep_minimum(change, low)
                point.isotropic_stress(law, constants, finite, H, change, weight, T)
                point.along(T, inverse, first, P, 9 * q)
                continue
            for r in range(9):
                store(F, r, finite * load(H, r) + (1.0 if r % 4 == 0 else 0.0))
            point.strain(H, finite, e)
            J = 1.0 + finite * change
            if mixed:
                for v in range(6):
                    store(e, v, load(e, v) - load(strain_gap[block, q], v))
                change = point.square(e)
            keep_minimum(change, low)
            j = change / (1.0 + sqrt(1.0 + change)) if mixed else change
            point.stress(law, constants, e, j, X, S, D, moduli)
            if volumes is not None:
                own_j = j if finite > 0.0 else point.change_of_volume(H, finite)
                point.invert(e, X, Y)  # also for laws without C^-1
                if finite == 0.0:
                    for v in range(6):
                        store(X, v, 1.0 if v < 3 else 0.0)
                pressure, modulus = point.dilatation(law, constants, finite, load(bulk, 0), own_j)
                own_J = 1.0 + finite * j
                point.add_pressure(-pressure, -modulus, own_J, X, finite, S, D, moduli)
            for v in range(6):
                store(ahead, v, load(S, v))
            if mixed:
                point.extrapolate(D, strain_gap[block, q], ahead)
            if volumes is not None:
                if mixed:
                    point.strain(H, finite, e)
                    point.invert(e, X, Y)
                p, p_ahead, _ = pressures
                for pressure, own_S, own_D in ((p_ahead, ahead, False), (p, S, moduli)):
                    value = value_of(pressure, functions[q])
                    point.add_pressure(value, 0.0, J, X, finite, own_S, D, own_D)
                if moduli:
                    for r in range(9):  # dJ/dF
                        store(T, r, point.cofactor(F, r // 3, r % 3))
                    point.along(T, inverse, first, H, 0)
                    for m in range(M):
                        factor = weight * load(functions[q], m)
                        for r in range(9):
                            store(stresses[m], 9 * q + r, factor * load(H, r))
            point.nominal_stress(F, ahead, weight, T)
            point.along(T, inverse, first, P, 9 * q)
            if moduli:
                point.nominal_moduli(F, inverse, first, D, S, weight, finite, A, q, Q)
        forces_of_cell(reference, P, fe)
        scatter(fe, numbers[block], count, force, dim)
        if moduli:
            stiffness_of_cell(reference, A, dim, K)
            if volumes is not None:
                for m in range(M):
                    forces_of_cell(reference, stresses[m], slopes[m])
                add_volumetric_stiffness(slopes, pressures[2], dim, CV, K)
            scatter_entries(K, places[block], values)
    lowest = np.inf
    for lane in range(SIMD_WIDTH):
        lowest = min(lowest, low[0, lane])
    return lowest


@njit(error_model="numpy", cache=True)
def add_gap(gap, length, update, u, cells, reference, inverse, dV, psi):
    """Add to the gaps of strain and of volume what a step (N, D) to u (N, D) changes nonlinearly.

    That of the strain is length^2 dH^T dH. For the gaps see `add_system`; `psi` are the functions
    of the volume change, (blocks or 1, Q, M, SIMD_WIDTH), or None. No law is an argument: numba
    would compile the loop for each.
    """
    (numbers, _), (strains, volumes) = cells, gap
    n, Q, dim = numbers.shape[1], dV.shape[1], u.shape[1]
    ue, G, H, F = rows(3 * n), rows(9 * Q), registers(9), registers(9)
    at, deformed = rows(3 * n), rows(9 * Q)
    for block in range(len(numbers)):
        gather(update, numbers[block], dim, ue)
        slopes_of_cell(reference, ue, G)
        if psi is not None:
            gather(u, numbers[block], dim, at)
            slopes_of_cell(reference, at, deformed)
        for q in range(Q):
            own, first = strains[block, q], first_row(inverse, block, q)
            gradient(G, q, inverse, first, H)
            for r in range(9):
                store(H, r, length * load(H, r))
            point.quadratic(H, 1.0, own)
            if psi is not None:
                gradient(deformed, q, inverse, first, F)
                weight = load(dV, first_row(dV, block, q))
                change = point.second_volume_change(F, H)
                functions = psi[block if len(psi) > 1 else 0]
                add_projected(weight * change, functions[q], volumes[block])


@inlined
def set_moduli(law, c, finite, H, A):
    """Set A (rows of `PAIR`) to dP/dF at H."""
    e, X, S, F = registers(6), registers(6), registers(6), registers(9)
    D, unit = registers(36), registers(9)
    point.strain(H, finite, e)
    point.stress(law, c, e, point.volume_change(H), X, S, D, True)
    for r in range(9):
        store(unit, r, 1.0 if r % 4 == 0 else 0.0)
        store(F, r, finite * load(H, r) + load(unit, r))
    point.nominal_moduli(F, unit, 0, D, S, 1.0, finite, A, 0, 1)


@njit(error_model="numpy", cache=True)
def moduli_change_product(law, c, finite, u, cells, dN, dV, basis, out):
    """Set out to dV (A(H) - A(0)) G of sampled cells with one point each, (C, D D, R) in float32.

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
        set_moduli(law, constants, finite, H, rest)
        for lane in range(SIMD_WIDTH):
            cell = start + min(lane, count - 1)
            for a in range(cells.shape[1]):
                for i in range(dim):
                    for j in range(dim):
                        H[3 * i + j, lane] += u[cells[cell, a], i] * dN[cell, 0, a, j]
        set_moduli(law, constants, finite, H, A)
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

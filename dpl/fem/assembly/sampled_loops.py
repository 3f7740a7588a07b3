"""Compiled loops of one prediction of an unrolled reduced solver.

`SIMD_WIDTH` sample cells are processed at once, one per SIMD lane; H and features of a block of
cells are rows of vectors. Features and sums are float64 and matrices float32: the sums cancel
digits of the features, and the matrices are rounded before the next one is fitted.
Tests compare the loops with the tensor operations of `dpl.fem.rom.sampled_stress`.
"""

import inspect
import sys
from typing import NamedTuple

import numpy as np
from numba import float32, float64, njit, void
from numpy.typing import NDArray

from dpl.fem.assembly import constitutive_kernels as point
from dpl.fem.assembly import numba_laws, simd
from dpl.fem.assembly.simd import SIMD_WIDTH, load, store
from dpl.fem.linear import banded
from dpl.fem.linear.banded import banded_triangular_solve

POLAR_ITER = 5  # Newton iterations of a polar decomposition
MIN_VOLUME_RATIO = 0.05  # det F below which a sample counts as undeformed [-]
SERIES_ANGLE = 0.3  # rotation angle below which sin(t)/t - 1 is its series [rad]
SOURCES = "".join(
    inspect.getsource(m) for m in (simd, numba_laws, point, banded, sys.modules[__name__])
)


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


class OrbitArrays(NamedTuple):
    """Degrees of freedom by parity p and symmetry g, see `dpl.fem.rom.parity`.

    Attributes:
        characters: Factor of parity p under symmetry g, (M, M).
        dofs: Images of one degree of freedom of each of m orbits, (M, m).
        signs: Factors of these images, (M, m).
        weights: Factors of the orbits in sums over all degrees of freedom, (m,).
    """

    characters: NDArray[np.float64]
    dofs: NDArray[np.int64]
    signs: NDArray[np.float64]
    weights: NDArray[np.float64]


class BasisArrays(NamedTuple):
    """R modes by parity; r is the largest number of modes of a parity.

    Attributes:
        columns: Positions of the coordinates of each parity, (M, r); R where there are fewer.
        modes: One value of each orbit, (M, r, m).
    """

    columns: NDArray[np.int64]
    modes: NDArray[np.float32]


class MapArrays(NamedTuple):
    """Maps of the iterations at the sample cells, by parity.

    b: orbits of entries of tensors at the sample cells, in blocks of 9 rows, and twice as many in
    blocks of 18.

    Attributes:
        gradients: G, (M, r, b).
        rest: Gradients of the prescribed displacement, (M, b).
        entry_signs: Factors of the images of entries of G, (M, b).
        first_signs: The same times weights of the orbits, (M, b).
        map_signs: The same for two tensors, (M, 2 b).
        first: B_0, (M, b, r).
        others: B_1, ..., (K, M, 2 b, r).
        limits: Largest ratio of each correction to the one before, (1 + K,).
    """

    gradients: NDArray[np.float32]
    rest: NDArray[np.float64]
    entry_signs: NDArray[np.float64]
    first_signs: NDArray[np.float64]
    map_signs: NDArray[np.float64]
    first: NDArray[np.float32]
    others: NDArray[np.float32]
    limits: NDArray[np.float64]


class LinearArrays(NamedTuple):
    """The linear solution K(0)^-1 (f - s) by a factor or, if that has no rows, in modes.

    Attributes:
        factor: Factors of K(0) by parity, (M, m, w), see `dpl.fem.rom.parity_factor`.
        order: Orbit of each row of the factors, (m,).
        supports: s = K(0) p of the prescribed displacement p, by parity, (M, m).
        basis: Modes of linear solutions.
        probes: See `dpl.models.linear_response`, (N D, F).
        tol: Part of the linear solution that the modes miss, above which a load is local.
    """

    factor: NDArray[np.float32]
    order: NDArray[np.int64]
    supports: NDArray[np.float64]
    basis: BasisArrays
    probes: NDArray[np.float32]
    tol: float


class ModelArrays(NamedTuple):
    """Arrays of an unrolled reduced solver.

    Attributes:
        orbits: Degrees of freedom.
        basis: Modes of the nonlinear displacement.
        maps: Maps of the iterations.
        linear: The linear solution.
    """

    orbits: OrbitArrays
    basis: BasisArrays
    maps: MapArrays
    linear: LinearArrays


@njit(fastmath=True)
def dot(x, row):
    """Return the product of a vector and a row of float32."""
    total = 0.0
    for j in range(len(x)):
        total += x[j] * row[j]
    return total


@njit(fastmath=True)
def split(characters, signs, images, out):
    """Set `out` (M, b) to the parts of each parity of values (M, b) at all images."""
    out[:] = 0.0
    for p in range(len(characters)):
        for g in range(len(characters)):
            factor = characters[p, g]
            for j in range(out.shape[1]):
                out[p, j] += factor * signs[g, j] * images[g, j]


@njit(fastmath=True)
def join(characters, signs, parts, out):
    """Add the values at all images of parts (M, b) of each parity to `out` (M, b)."""
    for g in range(len(characters)):
        for p in range(len(characters)):
            factor = characters[p, g]
            for j in range(out.shape[1]):
                out[g, j] += factor * signs[g, j] * parts[p, j]


@njit
def of_parity(columns, coordinates, out):
    """Set `out` (r,) to the coordinates of one parity, zero where there are fewer."""
    for k in range(len(columns)):
        out[k] = coordinates[columns[k]] if columns[k] < len(coordinates) else 0.0


@njit
def set_gradients(model, coordinates, own, parts, H):
    """Set H (M, b) at all images of the sample cells; `own` (r,) and `parts` (M, b) are work."""
    parts[:] = 0.0
    for p in range(len(parts)):
        of_parity(model.basis.columns[p], coordinates, own)
        add_product(own, model.maps.gradients[p], parts[p])
    H[:] = model.maps.rest
    join(model.orbits.characters, model.maps.entry_signs, parts, H)


@njit
def set_step(model, signs, matrices, features, parts, own, step):
    """Set step (R,) to the product of features (M, b) with matrices (M, b, r)."""
    split(model.orbits.characters, signs, features, parts)
    for p in range(len(parts)):
        own[:] = 0.0
        add_product(parts[p], matrices[p], own)
        for k in range(len(own)):
            if model.basis.columns[p, k] < len(step):
                step[model.basis.columns[p, k]] = own[k]


@njit
def force_by_parity(orbits, force):
    """Return a force (N D,) by parity, (M, m): the products with fields of one orbit."""
    M, m = orbits.dofs.shape
    parts = np.zeros((M, m))
    for g in range(M):
        for j in range(m):
            value = force[orbits.dofs[g, j]]
            if value != 0.0:
                value *= orbits.signs[g, j] * orbits.weights[j]
                for p in range(M):
                    parts[p, j] += orbits.characters[p, g] * value
    return parts


@njit
def galerkin(basis, inverse, supports, parts):
    """Return the coordinates (R,) of the Galerkin linear solution of a force by parity (M, m)."""
    right = -supports
    for p in range(len(parts)):
        for k in range(basis.columns.shape[1]):
            if basis.columns[p, k] < len(right):
                right[basis.columns[p, k]] += dot(parts[p], basis.modes[p, k])
    return inverse @ right


@njit
def add_modes(basis, coordinates, values):
    """Add V c to values by parity (M, m)."""
    own = np.zeros(basis.columns.shape[1])
    for p in range(len(values)):
        of_parity(basis.columns[p], coordinates, own)
        add_product(own, basis.modes[p], values[p])


@njit
def set_linear_solution(linear, parts, values):
    """Set values (M, m) to K(0)^-1 (f - s) of a force by parity (M, m)."""
    right, order = np.zeros(len(linear.order), np.float32), linear.order
    for p in range(len(parts)):
        size = 0.0
        for j in range(len(order)):
            size = max(size, abs(parts[p, j] - linear.supports[p, j]))
        if size > 0.0:  # scaled to order one, so that float32 holds it
            for j in range(len(order)):
                right[j] = (parts[p, order[j]] - linear.supports[p, order[j]]) / size
            solved = banded_triangular_solve(linear.factor[p], right)
            for j in range(len(order)):
                values[p, order[j]] = size * solved[j]


@njit
def is_local(linear, force, coordinates):
    """Return True if the modes miss too much of the linear solution with these coordinates."""
    products = np.zeros(linear.probes.shape[1])
    add_product(force, linear.probes, products)
    missing = (products * products).mean() if len(products) else 0.0
    return missing > linear.tol**2 * ((coordinates * coordinates).sum() + missing)


@njit
def set_field(orbits, values, field):
    """Set a field (N D,) at free degrees of freedom from values by parity (M, m)."""
    M, m = orbits.dofs.shape
    for g in range(M):
        for j in range(m):
            value = 0.0
            for p in range(M):
                value += orbits.characters[p, g] * values[p, j]
            field[orbits.dofs[g, j]] = orbits.signs[g, j] * value


@njit(error_model="numpy")
def nonlinear_coordinates(law, c, needs, finite, mu, lam, model, linear):
    """Return coordinates (R,) of the nonlinear displacement.

    Args:
        law, c, needs, finite, mu, lam: The law, see `dpl.fem.assembly.kernels`.
        model: The arrays of the model.
        linear: Coordinates of the Galerkin linear solution, (R,).
    """
    M, b = model.maps.rest.shape
    shape = M * b // (9 * SIMD_WIDTH), 9, SIMD_WIDTH
    own = np.zeros(model.basis.columns.shape[1])
    parts, both = np.zeros((M, b)), np.zeros((M, 2 * b))
    HL, H, features = np.zeros((M, b)), np.zeros((M, b)), np.zeros(shape)
    stress, work = np.zeros((M, 2 * b)), np.zeros((100, SIMD_WIDTH))
    blocks = stress.reshape((shape[0], 18, SIMD_WIDTH))
    set_gradients(model, linear, own, parts, HL)
    linear_blocks, present = HL.reshape(shape), H.reshape(shape)
    for k in range(shape[0]):
        rotated_strain(linear_blocks[k], features[k])
    maps, step = model.maps, np.zeros(len(linear))
    set_step(model, maps.first_signs, maps.first, features.reshape((M, b)), parts, own, step)
    size = limit_step(step, maps.limits[0] * np.sqrt((linear * linear).sum()))
    total = step.copy()
    for i in range(len(maps.others)):
        set_gradients(model, linear + total, own, parts, H)
        for k in range(shape[0]):
            unbalanced_stress(
                law, c, needs, finite, mu, lam, present[k], linear_blocks[k], work, blocks[k]
            )
        set_step(model, maps.map_signs, maps.others[i], stress, both, own, step)
        size = limit_step(step, maps.limits[i + 1] * size)
        total += step
    return total


@njit(error_model="numpy", cache=True)
def predict(law, c, needs, finite, mu, lam, model, reduced, reduced_linear, force, field):
    """Set the field of a prediction.

    Args:
        law, c, needs, finite, mu, lam: The law, see `dpl.fem.assembly.kernels`.
        model: The arrays of the model.
        reduced: (V^T K(0) V)^-1, (R, R), and V^T K(0) p of the prescribed displacement p, (R,).
        reduced_linear: The same of the modes of linear solutions.
        force: f, (N D,).
        field: Displacement at free degrees of freedom, (N D,); of a local load without the
            linear solution.

    Returns:
        True for a local load.
    """
    parts = force_by_parity(model.orbits, force)
    values = np.zeros(parts.shape)
    local = False
    if len(model.linear.order):
        set_linear_solution(model.linear, parts, values)
    else:
        coordinates = galerkin(model.linear.basis, reduced_linear[0], reduced_linear[1], parts)
        local = is_local(model.linear, force, coordinates)
        if not local:
            add_modes(model.linear.basis, coordinates, values)
    linear = galerkin(model.basis, reduced[0], reduced[1], parts)
    found = nonlinear_coordinates(law, c, needs, finite, mu, lam, model, linear)
    add_modes(model.basis, found, values)
    set_field(model.orbits, values, field)
    return local

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


class ModelArrays(NamedTuple):
    """Arrays of an unrolled reduced solver, by parity p and symmetry g, see `dpl.fem.rom.parity`.

    m: orbits of degrees of freedom; b: orbits of entries of tensors at the sample cells, in blocks
    of 9 rows, and twice as many in blocks of 18; r: largest number of modes of a parity, R in all.

    Attributes:
        characters: Factor of parity p under symmetry g, (M, M).
        dofs: Images of one degree of freedom of each orbit, (M, m).
        signs: Factors of these images, (M, m).
        weights: Factors of the orbits in sums over all degrees of freedom, (m,).
        columns: Positions of the coordinates of each parity, (M, r); R where there are fewer.
        modes: V, (M, r, m).
        probes: See `dpl.models.local_response`, (N D, F).
        gradients: G, (M, r, b).
        rest: Gradients of the prescribed displacement, (M, b).
        entry_signs: Factors of the images of entries of G, (M, b).
        first_signs: The same times weights of the orbits, (M, b).
        map_signs: The same for two tensors, (M, 2 b).
        first: B_0, (M, b, r).
        maps: B_1, ..., (K, M, 2 b, r).
        limits: Largest ratio of each correction to the one before, (1 + K,).
    """

    characters: NDArray[np.float64]
    dofs: NDArray[np.int64]
    signs: NDArray[np.float64]
    weights: NDArray[np.float64]
    columns: NDArray[np.int64]
    modes: NDArray[np.float32]
    probes: NDArray[np.float32]
    gradients: NDArray[np.float32]
    rest: NDArray[np.float64]
    entry_signs: NDArray[np.float64]
    first_signs: NDArray[np.float64]
    map_signs: NDArray[np.float64]
    first: NDArray[np.float32]
    maps: NDArray[np.float32]
    limits: NDArray[np.float64]


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
        of_parity(model.columns[p], coordinates, own)
        add_product(own, model.gradients[p], parts[p])
    H[:] = model.rest
    join(model.characters, model.entry_signs, parts, H)


@njit
def set_step(model, signs, matrices, features, parts, own, step):
    """Set step (R,) to the product of features (M, b) with matrices (M, b, r)."""
    split(model.characters, signs, features, parts)
    for p in range(len(parts)):
        own[:] = 0.0
        add_product(parts[p], matrices[p], own)
        for k in range(len(own)):
            if model.columns[p, k] < len(step):
                step[model.columns[p, k]] = own[k]


@njit
def reduced_force(model, force, right):
    """Add V^T f to `right` (R,) for a force (N D,)."""
    M, m = model.dofs.shape
    parts = np.zeros((M, m))
    for g in range(M):
        for j in range(m):
            value = force[model.dofs[g, j]]
            if value != 0.0:
                value *= model.signs[g, j] * model.weights[j]
                for p in range(M):
                    parts[p, j] += model.characters[p, g] * value
    for p in range(M):
        for k in range(model.columns.shape[1]):
            if model.columns[p, k] < len(right):
                right[model.columns[p, k]] += dot(parts[p], model.modes[p, k])


@njit
def set_field(model, coordinates, field):
    """Set a field (N D,) to V c at free degrees of freedom."""
    M, m = model.dofs.shape
    parts, own = np.zeros((M, m)), np.zeros(model.columns.shape[1])
    for p in range(M):
        of_parity(model.columns[p], coordinates, own)
        add_product(own, model.modes[p], parts[p])
    for g in range(M):
        for j in range(m):
            value = 0.0
            for p in range(M):
                value += model.characters[p, g] * parts[p, j]
            field[model.dofs[g, j]] = model.signs[g, j] * value


@njit(error_model="numpy", cache=True)
def predict(law, c, needs, finite, mu, lam, model, force, inverse, supports, tol, field):
    """Set the field of a prediction.

    Args:
        law, c, needs, finite, mu, lam: The law, see `dpl.fem.assembly.kernels`.
        model: The arrays of the model.
        force: f, (N D,).
        inverse: (V^T K(0) V)^-1, (R, R).
        supports: V^T K(0) p of the prescribed displacement p, (R,).
        tol: Relative size of the part of the linear solution that the modes miss, above which the
            load is local.
        field: Displacement at free degrees of freedom, (N D,); of a local load without the
            linear solution in the modes.

    Returns:
        True for a local load.
    """
    right = -supports
    reduced_force(model, force, right)
    linear = inverse @ right
    M, b = model.rest.shape
    shape = M * b // (9 * SIMD_WIDTH), 9, SIMD_WIDTH
    own, parts, both = np.zeros(model.columns.shape[1]), np.zeros((M, b)), np.zeros((M, 2 * b))
    HL, H, features, stress = (
        np.zeros((M, b)),
        np.zeros((M, b)),
        np.zeros(shape),
        np.zeros((M, 2 * b)),
    )
    work, blocks = np.zeros((100, SIMD_WIDTH)), stress.reshape((shape[0], 18, SIMD_WIDTH))
    set_gradients(model, linear, own, parts, HL)
    linear_blocks, present = HL.reshape(shape), H.reshape(shape)
    for k in range(shape[0]):
        rotated_strain(linear_blocks[k], features[k])
    step = np.zeros(len(linear))
    set_step(model, model.first_signs, model.first, features.reshape((M, b)), parts, own, step)
    size = limit_step(step, model.limits[0] * np.sqrt((linear * linear).sum()))
    whole = linear + step
    for i in range(len(model.maps)):
        set_gradients(model, whole, own, parts, H)
        for k in range(shape[0]):
            unbalanced_stress(
                law, c, needs, finite, mu, lam, present[k], linear_blocks[k], work, blocks[k]
            )
        set_step(model, model.map_signs, model.maps[i], stress, both, own, step)
        size = limit_step(step, model.limits[i + 1] * size)
        whole += step
    products = np.zeros(model.probes.shape[1])
    add_product(force, model.probes, products)
    missing = (products * products).mean() if len(products) else 0.0
    is_local = missing > tol * tol * ((linear * linear).sum() + missing)
    set_field(model, whole - linear if is_local else whole, field)
    return is_local

"""Compiled loops of one prediction of an unrolled reduced solver.

Features and sums are float64 and matrices float32: the sums cancel digits of the features, and the
matrices are rounded before the next one is fitted. Tests compare the loops with the tensor
operations of `dpl.models.Unrolled`.
"""

import inspect
import sys
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dpl.fem.assembly import element_loops
from dpl.fem.assembly.lanes import gather_constants, rows
from dpl.fem.assembly.simd import SIMD_WIDTH
from dpl.fem.linear import condensation
from dpl.fem.linear.condensation import add_product, subtract_product
from dpl.models.linear_response import OrbitArrays
from dpl.models.unrolled import feature_loops
from dpl.models.unrolled.feature_loops import rotated_strain, unbalanced_stress

SOURCES = (
    element_loops.SOURCES
    + feature_loops.SOURCES
    + "".join(inspect.getsource(m) for m in (condensation, sys.modules[__name__]))
)


@njit
def limit_step(step, most):
    """Shorten a step (R,) to a norm of at most `most`; return its norm."""
    size = np.sqrt((step * step).sum())
    if size > most:
        step *= most / size
        return most
    return size


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
        first: B_0^T, (M, r, b).
        others: B_1^T, ..., (K, M, r, 2 b).
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


class ModelArrays(NamedTuple):
    """Arrays of an unrolled reduced solver.

    Attributes:
        orbits: Degrees of freedom.
        basis: Modes of the nonlinear displacement.
        maps: Maps of the iterations.
    """

    orbits: OrbitArrays
    basis: BasisArrays
    maps: MapArrays


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
    """Set step (R,) to the product of features (M, b) with matrices (M, r, b)."""
    split(model.orbits.characters, signs, features, parts)
    for p in range(len(parts)):
        own[:] = 0.0
        subtract_product(matrices[p], parts[p], own)
        for k in range(len(own)):
            if model.basis.columns[p, k] < len(step):
                step[model.basis.columns[p, k]] = -own[k]


@njit
def galerkin(basis, inverse, parts):
    """Return the coordinates (R,) of the Galerkin linear solution of a force by parity (M, m)."""
    right = np.zeros(len(inverse))
    for p in range(len(parts)):
        own = np.zeros(basis.columns.shape[1], parts.dtype)
        subtract_product(basis.modes[p], parts[p], own)
        for k in range(len(own)):
            if basis.columns[p, k] < len(right):
                right[basis.columns[p, k]] = -own[k]
    found = np.zeros(len(inverse))
    add_product(right, inverse, found)  # no BLAS, whose threads wait for each other
    return found


@njit
def add_modes(basis, coordinates, values):
    """Add V c to values by parity (M, m)."""
    own = np.zeros(basis.columns.shape[1], values.dtype)
    for p in range(len(values)):
        of_parity(basis.columns[p], coordinates, own)
        add_product(own, basis.modes[p], values[p])


@njit(fastmath=True)
def set_field(orbits, values, unit, field):
    """Set a field (N D,) at free degrees of freedom from values over a unit by parity (M, m)."""
    M, m = orbits.dofs.shape
    own = np.empty(m)
    for g in range(M):
        own[:] = 0.0
        for p in range(M):
            factor = unit * orbits.characters[p, g]
            for j in range(m):
                own[j] += factor * values[p, j]
        for j in range(m):
            field[orbits.dofs[g, j]] = orbits.signs[g, j] * own[j]


@njit(error_model="numpy")
def nonlinear_coordinates(law, c, needs, finite, model, linear, sizes):
    """Return coordinates (R,) of the nonlinear displacement.

    Args:
        law, c, needs, finite: The law, see `dpl.models.unrolled.compiled.law_arguments`.
        model: The arrays of the model.
        linear: Coordinates of the Galerkin linear solution, (R,).
        sizes: Norms of these coordinates and of the corrections by the maps, (K + 2,); set.
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
    constants = rows(c.shape[1])
    for k in range(shape[0]):
        rotated_strain(linear_blocks[k], features[k])
    maps, step = model.maps, np.zeros(len(linear))
    set_step(model, maps.first_signs, maps.first, features.reshape((M, b)), parts, own, step)
    sizes[0] = np.sqrt((linear * linear).sum())
    sizes[1] = limit_step(step, maps.limits[0] * sizes[0])
    total = step.copy()
    for i in range(len(maps.others)):
        set_gradients(model, linear + total, own, parts, H)
        for k in range(shape[0]):
            gather_constants(c, SIMD_WIDTH * k, SIMD_WIDTH, constants)
            unbalanced_stress(
                law, constants, needs, finite, present[k], linear_blocks[k], work, blocks[k]
            )
        set_step(model, maps.map_signs, maps.others[i], stress, both, own, step)
        sizes[i + 2] = limit_step(step, maps.limits[i + 1] * sizes[i + 1])
        total += step
    return total


@njit(error_model="numpy", nogil=True, cache=True)
def predict(law, c, needs, finite, model, inverse, unit, parts, solution, field, sizes):
    """Set the field of a prediction.

    Args:
        law, c, needs, finite: The law, see `dpl.models.unrolled.compiled.law_arguments`.
        model: The arrays of the model.
        inverse: (V^T K(0) V)^-1, (R, R).
        unit, parts, solution: Force and linear solution by parity, see `LinearResponse.at`; the
            solution is overwritten.
        field: Displacement at free degrees of freedom, (N D,).
        sizes: Norms of the corrections, see `nonlinear_coordinates`.
    """
    linear = unit * galerkin(model.basis, inverse, parts)
    found = nonlinear_coordinates(law, c, needs, finite, model, linear, sizes)
    add_modes(model.basis, found / unit, solution)
    set_field(model.orbits, solution, unit, field)

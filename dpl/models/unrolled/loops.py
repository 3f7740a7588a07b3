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
from dpl.fem.linear import condensed_loops
from dpl.fem.linear.condensed_loops import add_product, subtract_product
from dpl.fem.solvers import parity_factor
from dpl.fem.solvers.parity_factor import OrbitArrays, join_field
from dpl.models.unrolled import feature_loops
from dpl.models.unrolled.feature_loops import rotated_strain, unbalanced_stress

SOURCES = (
    element_loops.SOURCES
    + feature_loops.SOURCES
    + "".join(inspect.getsource(m) for m in (condensed_loops, parity_factor, sys.modules[__name__]))
)


@njit
def limit_step(step, most):
    """Shorten a step (R,) to a norm of at most `most`; return its norm."""
    size = np.sqrt((step * step).sum())
    if size > most:
        step *= most / size
        return most
    return size


class ModelArrays(NamedTuple):
    """Arrays of an unrolled reduced solver with R modes, by parity.

    r: largest number of modes of a parity. b: orbits of entries of tensors at the sample cells, in
    blocks of 9 rows, and twice as many in blocks of 18.

    Attributes:
        orbits: Degrees of freedom.
        columns: Positions of the coordinates of each parity, (M, r); R where there are fewer.
        modes: One value of each orbit, (M, r, m).
        gradients: G, (M, r, b).
        rest: Gradients of the prescribed displacement, (M, b).
        entry_signs: Factors of the images of entries of G, (M, b).
        first_signs: The same times weights of the orbits, (M, b).
        map_signs: The same for two tensors, (M, 2 b).
        first_map: B_0^T, (M, r, b).
        maps: B_1^T, ..., (K, M, r, 2 b).
        limits: Largest ratio of each correction to the one before, (1 + K,).
    """

    orbits: OrbitArrays
    columns: NDArray[np.int64]
    modes: NDArray[np.float32]
    gradients: NDArray[np.float32]
    rest: NDArray[np.float64]
    entry_signs: NDArray[np.float64]
    first_signs: NDArray[np.float64]
    map_signs: NDArray[np.float64]
    first_map: NDArray[np.float32]
    maps: NDArray[np.float32]
    limits: NDArray[np.float64]


@njit(fastmath=True)
def split(characters, signs, images, out):
    """Set `out` (M, b) to the parts of each parity of values (M, b) at all images."""
    signed = signs * images
    out[:] = 0.0
    for p in range(len(characters)):
        add_product(characters[p], signed, out[p])


@njit(fastmath=True)
def join(characters, signs, parts, out):
    """Add the values at all images of parts (M, b) of each parity to `out` (M, b)."""
    values = np.zeros_like(parts)
    for g in range(len(characters)):
        add_product(characters[:, g], parts, values[g])
    out += signs * values


@njit
def add_fields(columns, coordinates, matrices, values):
    """Add products of coordinates (R,) and matrices (M, r, b) to values by parity (M, b)."""
    own = np.zeros(columns.shape[1], values.dtype)
    for p in range(len(values)):
        for k in range(len(own)):
            inside = columns[p, k] < len(coordinates)
            own[k] = coordinates[columns[p, k]] if inside else 0.0
        add_product(own, matrices[p], values[p])


@njit
def set_coordinates(columns, matrices, values, coordinates):
    """Set coordinates (R,) to products of matrices (M, r, b) and values by parity (M, b)."""
    own = np.zeros(columns.shape[1], values.dtype)
    for p in range(len(values)):
        own[:] = 0.0
        subtract_product(matrices[p], values[p], own)
        for k in range(len(own)):
            if columns[p, k] < len(coordinates):
                coordinates[columns[p, k]] = -own[k]


@njit
def set_gradients(model, coordinates, parts, H):
    """Set H (M, b) at all images of the sample cells; `parts` (M, b) is work."""
    parts[:] = 0.0
    add_fields(model.columns, coordinates, model.gradients, parts)
    H[:] = 0.0  # numba compiles the assignment of an array for three seconds
    H += model.rest
    join(model.orbits.characters, model.entry_signs, parts, H)


@njit(error_model="numpy")
def nonlinear_coordinates(law, c, finite, model, linear, sizes):
    """Return coordinates (R,) of the nonlinear displacement; the arguments are as in `predict`.

    `linear` (R,) are the coordinates of the Galerkin linear solution.
    """
    M, b = model.rest.shape
    shape = M * b // (9 * SIMD_WIDTH), 9, SIMD_WIDTH
    parts, both = np.zeros((M, b)), np.zeros((M, 2 * b))
    HL, H, features = np.zeros((M, b)), np.zeros((M, b)), np.zeros(shape)
    stress, work = np.zeros((M, 2 * b)), np.zeros((100, SIMD_WIDTH))
    blocks = stress.reshape((shape[0], 18, SIMD_WIDTH))
    set_gradients(model, linear, parts, HL)
    linear_blocks, present = HL.reshape(shape), H.reshape(shape)
    constants, characters = rows(c.shape[1]), model.orbits.characters
    for k in range(shape[0]):
        rotated_strain(linear_blocks[k], features[k])
    step = np.zeros(len(linear))
    split(characters, model.first_signs, features.reshape((M, b)), parts)
    set_coordinates(model.columns, model.first_map, parts, step)
    sizes[0] = np.sqrt((linear * linear).sum())
    sizes[1] = limit_step(step, model.limits[0] * sizes[0])
    total = step.copy()
    for i in range(len(model.maps)):
        set_gradients(model, linear + total, parts, H)
        for k in range(shape[0]):
            gather_constants(c, SIMD_WIDTH * k, SIMD_WIDTH, constants)
            unbalanced_stress(law, constants, finite, present[k], linear_blocks[k], work, blocks[k])
        split(characters, model.map_signs, stress, both)
        set_coordinates(model.columns, model.maps[i], both, step)
        sizes[i + 2] = limit_step(step, model.limits[i + 1] * sizes[i + 1])
        total += step
    return total


@njit(error_model="numpy", nogil=True, cache=True)
def predict(law, c, finite, model, inverse, unit, parts, solution, field, sizes):
    """Set the field of a prediction.

    Args:
        law, c, finite: The law, see `dpl.models.unrolled.compiled.law_arguments`.
        model: The arrays of the model.
        inverse: (V^T K(0) V)^-1, (R, R).
        unit, parts, solution: Force and linear solution by parity, see `LinearResponse.at`; the
            solution is overwritten.
        field: Displacement at free degrees of freedom, (N D,).
        sizes: Norms of the linear coordinates and of the corrections by the maps, (K + 2,); set.
    """
    right, linear = np.zeros(len(inverse)), np.zeros(len(inverse))
    set_coordinates(model.columns, model.modes, parts, right)
    add_product(right, inverse, linear)  # no BLAS, whose threads wait for each other
    linear *= unit
    found = nonlinear_coordinates(law, c, finite, model, linear, sizes)
    add_fields(model.columns, found / unit, model.modes, solution)
    orbits = model.orbits
    join_field(orbits.characters, orbits.dofs, orbits.signs, solution, unit, field)

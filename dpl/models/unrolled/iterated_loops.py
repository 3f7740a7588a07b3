"""Compiled loops of one prediction whose linear solution takes several steps.

They differ from `dpl.models.unrolled.loops` in the linear solution only.
"""

import inspect
import sys
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dpl.fem.linear.condensation import condensed_iteration
from dpl.models.unrolled import loops
from dpl.models.unrolled.loops import (
    add_modes,
    force_by_parity,
    galerkin,
    nonlinear_coordinates,
    set_field,
)

SOURCES = loops.SOURCES + inspect.getsource(sys.modules[__name__])


class IterationArrays(NamedTuple):
    """Structure of K(0) of one parity, m orbits.

    Attributes:
        first_entry, columns: CSR structure, (m + 1,) and (nnz,).
        steps: Number of steps of a solution.
    """

    first_entry: NDArray[np.int32]
    columns: NDArray[np.int32]
    steps: int


@njit
def set_iterated_solution(linear, iteration, moduli, entries, parts, values):
    """Set values (M, m) to K(0)^-1 (f - s) of a force by parity (M, m).

    Args:
        linear: The arrays of the linear solution; the blocks are those of one parameter.
        iteration: The structure of K(0).
        moduli: Factors of the terms of K(0), and 1, (T + 1,).
        entries: Entries of K(0) by parity, (M, nnz).
        parts: The force by parity, (M, m).
        values: The solution.
    """
    right = np.empty(parts.shape[1])
    for p in range(len(parts)):
        right[:] = parts[p]
        for i in range(len(moduli)):
            right -= moduli[i] * linear.supports[i, p]
        matrix = iteration.first_entry, iteration.columns, entries[p]
        blocks = linear.table, linear.unknowns, linear.values[0, p]
        condensed_iteration(
            blocks[0], blocks[1], blocks[2], matrix, right, iteration.steps, values[p]
        )


@njit(error_model="numpy", nogil=True, cache=True)
def predict_iterated(law, c, needs, finite, model, iteration, reduced, of_law, force, field):
    """Set the field of a prediction, see `dpl.models.unrolled.loops.predict`.

    Args:
        law, c, needs, finite, model, reduced, force, field: As there.
        iteration: The structure of K(0).
        of_law: Moduli and entries of K(0) of the law, see `set_iterated_solution`.
    """
    parts = force_by_parity(model.orbits, force)
    values = np.empty(parts.shape)
    set_iterated_solution(model.linear, iteration, of_law[0], of_law[1], parts, values)
    linear = galerkin(model.basis, reduced[0], reduced[1], parts)
    found = nonlinear_coordinates(law, c, needs, finite, model, linear)
    add_modes(model.basis, found, values)
    set_field(model.orbits, values, field)

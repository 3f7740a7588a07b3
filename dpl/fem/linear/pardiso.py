"""Sparse LDL^T factors by PARDISO of Intel oneMKL."""

import os
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from dpl.fem.linear.interface import Array, Factor, Pattern, SingularMatrix, require_finite


@dataclass(frozen=True, eq=False)
class PardisoFactor(Factor):
    """LDL^T factor. MKL stores one at a time; solving with an older one factorises it again."""

    parent: "Pardiso"
    matrix: csr_array
    negative_pivots: int = 0

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), with K x = right."""
        if self.parent.factorised is not self.matrix:
            self.parent.store_factor(self.matrix)
        return self.parent.call(33, self.matrix, np.ascontiguousarray(right))  # ignores strides

    def apply(self, right: Array) -> Array:
        """Return `solve`; raise a SingularMatrix if MKL stores another factor."""
        if self.parent.factorised is not self.matrix:
            raise SingularMatrix("MKL stores the factor of another matrix")
        return self.solve(right)


class Pardiso:
    """MKL PARDISO for symmetric indefinite matrices.

    Source: Schenk, Gaertner (2004), Future Gener. Comput. Syst. 20.
    """

    def __init__(self, pattern: Pattern) -> None:
        """Store the pattern; the analysis runs with the first matrix."""
        self.pattern = pattern
        self._solver: Any = None
        self.factorised: csr_array | None = None  # matrix whose factor MKL stores

    def __reduce__(self) -> tuple[type["Pardiso"], tuple[Pattern]]:
        """Pickle without MKL's handle."""
        return Pardiso, (self.pattern,)

    def factorise(self, values: Array) -> PardisoFactor:
        """Return the factor, see `Backend.factorise`."""
        require_finite(values)
        entries = values.copy(), self.pattern.indices, self.pattern.indptr
        matrix = csr_array(entries, shape=(self.pattern.size,) * 2)
        self.store_factor(matrix)
        return PardisoFactor(self, matrix, int(self._solver.get_iparm(23)))

    def store_factor(self, matrix: csr_array) -> None:
        """Factorise a matrix in MKL, in place of the one whose factor it stores."""
        self.factorised = None
        if self._solver is None:
            from pypardiso import PyPardisoSolver

            self._solver = PyPardisoSolver(mtype=-2)
            for place, setting in SETTINGS.items():
                self._solver.set_iparm(place, setting)
            # Each process searches the whole environment for MKL, a second or more, if not told.
            os.environ.setdefault("PYPARDISO_MKL_RT", self._solver.libmkl._name)
            weakref.finalize(self, self._solver.free_memory, everything=True)
            self.call(11, matrix, np.zeros(self.pattern.size))
        self.call(22, matrix, np.zeros(self.pattern.size))
        if self._solver.get_iparm(14):  # MKL replaces zero pivots silently
            raise SingularMatrix(f"{self._solver.get_iparm(14)} pivots are zero to rounding")
        self.factorised = matrix

    def call(self, phase: int, matrix: csr_array, right: Array) -> Array:
        """Return the result of a phase of PARDISO, (n,): 11 analyse, 22 factorise, 33 solve."""
        from pypardiso.pardiso_wrapper import PyPardisoError

        self._solver.set_phase(phase)
        # One thread: two are slower at these sizes, and MKL crashes if their number changes
        # between analysis and factorisation.
        before = self._solver.libmkl.MKL_Set_Num_Threads_Local(1)
        try:
            return self._solver._call_pardiso(matrix, right.reshape(-1, 1)).ravel()
        except PyPardisoError as error:
            raise SingularMatrix(str(error)) from error
        finally:
            self._solver.libmkl.MKL_Set_Num_Threads_Local(before)


# MKL's iparm, counted from 1. By default MKL replaces pivots below 1e-8 ||A||, which occur in
# slender bodies far from singular.
SETTINGS = {
    1: 1,  # use these settings instead of the defaults
    2: 2,  # nested dissection
    8: 0,  # no refinement: Newton refines, and a step would cost as much as two solves
    10: 13,  # pivots below 1e-13 ||A|| are zero
    11: 0,
    13: 0,
}

"""Sparse LDL^T factors by PARDISO of Intel oneMKL."""

import os
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from dpl.fem.linear.interface import (
    Array,
    DirectFactor,
    Pattern,
    SingularMatrix,
    require_finite,
)


@dataclass(frozen=True, eq=False)
class PardisoFactor(DirectFactor):
    """LDL^T factor inside MKL, which holds one at a time: an older one is made anew when asked."""

    parent: "Pardiso"
    matrix: csr_array
    negative_pivots: int

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), with K x = right."""
        return self.parent.solve(self.matrix, right)

    def apply(self, right: Array) -> Array:
        """Return `solve`, if MKL still holds this factor.

        Raises:
            SingularMatrix: It holds another one.
        """
        if self.parent.held is not self.matrix:
            raise SingularMatrix("MKL holds the factor of another matrix")
        return self.solve(right)


class Pardiso:
    """MKL PARDISO (Schenk, Gaertner 2004), symmetric indefinite, where installed."""

    def __init__(self, pattern: Pattern) -> None:
        """Prepare; the analysis runs with the first matrix."""
        self.pattern = pattern
        self._solver: Any = None
        self.held: csr_array | None = None  # the matrix whose factor MKL holds

    def __reduce__(self) -> tuple[type["Pardiso"], tuple[Pattern]]:
        """Pickle without MKL's handle."""
        return Pardiso, (self.pattern,)

    def factorise(self, values: Array) -> PardisoFactor:
        """Return the factor, see `Backend.factorise`."""
        require_finite(values)
        pattern = self.pattern
        entries = values.copy(), pattern.indices, pattern.indptr
        matrix = csr_array(entries, shape=(pattern.size,) * 2)
        self._factorise(matrix)
        return PardisoFactor(self, matrix, int(self._solver.get_iparm(23)))

    def solve(self, matrix: csr_array, right: Array) -> Array:
        """Return x, (n,), with K x = right, for a matrix that has been factorised before."""
        if self.held is not matrix:
            self._factorise(matrix)
        return self._call(33, matrix, np.ascontiguousarray(right))  # MKL knows no strides

    def _factorise(self, matrix: csr_array) -> None:
        self.held = None
        if self._solver is None:
            from pypardiso import PyPardisoSolver

            self._solver = PyPardisoSolver(mtype=-2)
            for place, setting in SETTINGS.items():
                self._solver.set_iparm(place, setting)
            # Found by a search through the whole environment, a second or more: once is enough.
            os.environ.setdefault("PYPARDISO_MKL_RT", self._solver.libmkl._name)
            weakref.finalize(self, self._solver.free_memory, everything=True)
            self._call(11, matrix, np.zeros(self.pattern.size))
        self._call(22, matrix, np.zeros(self.pattern.size))
        if self._solver.get_iparm(14):  # MKL replaces pivots it cannot use and says nothing
            raise SingularMatrix(f"{self._solver.get_iparm(14)} pivots are zero to rounding")
        self.held = matrix

    def _call(self, phase: int, matrix: csr_array, right: Array) -> Array:
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


# MKL's iparm, counted from 1; by default it gives up pivots below 1e-8 ||A||, which slender bodies
# have that are far from singular.
SETTINGS = {
    1: 1,  # these settings, not the defaults
    2: 2,  # nested dissection
    8: 0,  # no refinement: Newton refines, and a step would cost as much as two solves
    10: 13,  # pivots below 1e-13 ||A|| are zero
    11: 0,
    13: 0,
}

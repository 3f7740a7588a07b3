"""K x = r for the sparse symmetric tangents of a problem: direct backends behind one function.

The symbolic work (ordering, structure) is done once per backend object, the numbers per call.
"""

import importlib.util
import os
import weakref
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from dpl.fem.problem import Pattern

Array = NDArray[np.float64]


class SingularMatrix(ArithmeticError):
    """The matrix has no usable factorisation."""


class Factor(Protocol):
    """A factorised matrix."""

    @property
    def negative_pivots(self) -> int:
        """Number of negative eigenvalues."""
        ...

    def solve(self, right: Array) -> Array:
        """Return x, (n,), with K x = right."""
        ...


class Backend(Protocol):
    """Factorises matrices of one pattern."""

    def factorise(self, values: Array) -> Factor:
        """Return the factor of the matrix with entries values (nnz,) on the pattern.

        Raises:
            SingularMatrix: An exact zero pivot, or entries that are not finite.
        """
        ...


def installed() -> list[str]:
    """Return the names of the backends that can be used here, the fastest first."""
    pardiso = importlib.util.find_spec("pypardiso") is not None
    return ["pardiso", "superlu"] if pardiso else ["superlu"]


def backend(pattern: Pattern, name: str = "auto") -> Backend:
    """Return the backend of that name ("auto": the fastest that is installed).

    Raises:
        ValueError: No such backend, or it is not installed.
    """
    return BACKENDS[chosen(name)](pattern)


def chosen(name: str) -> str:
    """Return the name of the backend that a name stands for.

    Raises:
        ValueError: No such backend, or it is not installed.
    """
    choice = installed()[0] if name == "auto" else name
    if choice not in BACKENDS:
        raise ValueError(f"linear = {name!r} must be auto, {' or '.join(BACKENDS)}")
    if choice not in installed():
        raise ValueError(f"linear = {name!r} is not installed: pip install 'deepphysics[{name}]'")
    return choice


def full_matrix(pattern: Pattern, values: Array) -> csr_array:
    """Return the whole symmetric matrix (n, n) of upper-triangle entries (nnz,)."""
    upper = csr_array((values, pattern.indices, pattern.indptr), shape=(pattern.size,) * 2)
    lower = upper.T.tocsr()
    lower.setdiag(0)
    lower.eliminate_zeros()
    return (upper + lower).tocsr()


@dataclass(frozen=True)
class SuperLUFactor:
    """LDL^T-like factor in a fill-reducing order."""

    lu: Any
    order: NDArray[np.int_]

    @property
    def negative_pivots(self) -> int:
        """Number of negative eigenvalues (Sylvester's law of inertia; diagonal pivots only)."""
        return int((self.lu.U.diagonal() < 0).sum())

    def solve(self, right: Array) -> Array:
        """Return x, (n,), with K x = right."""
        x = np.empty_like(right)
        x[self.order] = self.lu.solve(right[self.order])
        return x


@dataclass(frozen=True, eq=False)
class SuperLU:
    """SciPy's SuperLU in symmetric mode (Li, Demmel 2003): on every machine."""

    pattern: Pattern

    @cached_property
    def _plan(self) -> tuple[NDArray[np.int_], csc_array, NDArray[np.int_]]:
        """Minimum-degree order, structure of the reordered matrix, where its entries come from."""
        n, count = self.pattern.size, len(self.pattern.indices)
        rows = np.repeat(np.arange(n), np.diff(self.pattern.indptr))
        columns = self.pattern.indices
        model = np.where(rows == columns, 4.0 * count, -1.0)  # any positive definite values
        whole = full_matrix(self.pattern, model).tocsc()
        order = np.argsort(splu(whole, **_symmetric("MMD_AT_PLUS_A")).perm_c)
        place = np.empty(n, dtype=np.int64)
        place[order] = np.arange(n)
        off = np.flatnonzero(rows != columns)
        r = place[np.concatenate([rows, columns[off]])]
        c = place[np.concatenate([columns, rows[off]])]
        source = np.concatenate([np.arange(count), off])
        by_column = np.lexsort([r, c])
        indptr = np.searchsorted(c[by_column], np.arange(n + 1))
        structure = csc_array((np.zeros(len(r)), r[by_column], indptr), shape=(n, n))
        return order, structure, source[by_column]

    def factorise(self, values: Array) -> SuperLUFactor:
        """Return the factor, see `Backend.factorise`."""
        if not np.isfinite(values).all():
            raise SingularMatrix("the matrix has entries that are not finite")
        order, structure, source = self._plan
        matrix = csc_array((values[source], structure.indices, structure.indptr), structure.shape)
        try:
            return SuperLUFactor(splu(matrix, **_symmetric("NATURAL")), order)
        except RuntimeError as error:
            raise SingularMatrix(str(error)) from error


def _symmetric(order: str) -> dict[str, Any]:
    """Return the settings for which SuperLU keeps to diagonal pivots."""
    return {"permc_spec": order, "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


@dataclass(frozen=True)
class PardisoFactor:
    """LDL^T factor inside MKL; valid until its backend factorises the next matrix."""

    parent: "Pardiso"
    matrix: csr_array
    negative_pivots: int

    def solve(self, right: Array) -> Array:
        """Return x, (n,), with K x = right."""
        return self.parent._call(33, self.matrix, right)


class Pardiso:
    """MKL PARDISO (Schenk, Gaertner 2004), symmetric indefinite: the fastest, where installed."""

    def __init__(self, pattern: Pattern) -> None:
        """Prepare; the analysis runs with the first matrix."""
        self.pattern = pattern
        self._solver: Any = None

    def __reduce__(self) -> tuple[type["Pardiso"], tuple[Pattern]]:
        """Pickle without MKL's handle."""
        return Pardiso, (self.pattern,)

    def factorise(self, values: Array) -> PardisoFactor:
        """Return the factor, see `Backend.factorise`."""
        if not np.isfinite(values).all():
            raise SingularMatrix("the matrix has entries that are not finite")
        pattern = self.pattern
        matrix = csr_array((values, pattern.indices, pattern.indptr), shape=(pattern.size,) * 2)
        if self._solver is None:
            from pypardiso import PyPardisoSolver

            self._solver = PyPardisoSolver(mtype=-2)
            # Found by a search through the whole environment, a second or more: once is enough.
            os.environ.setdefault("PYPARDISO_MKL_RT", self._solver.libmkl._name)
            weakref.finalize(self, self._solver.free_memory, everything=True)
            self._call(11, matrix, np.zeros(pattern.size))
        self._call(22, matrix, np.zeros(pattern.size))
        if self._solver.get_iparm(14):  # MKL replaces pivots it cannot use and says nothing
            raise SingularMatrix(f"{self._solver.get_iparm(14)} pivots are zero to rounding")
        return PardisoFactor(self, matrix, int(self._solver.get_iparm(23)))

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


BACKENDS: dict[str, type[Pardiso] | type[SuperLU]] = {"superlu": SuperLU, "pardiso": Pardiso}

"""K x = r for the sparse symmetric tangents of a problem: several backends behind one function.

The symbolic work (ordering, structure) is done once per backend object, the numbers per call.
"""

import importlib.util
import os
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu
from threadpoolctl import threadpool_info

from dpl.fem.band import Band, Band32, band_layout
from dpl.fem.krylov import CG, multigrid_installed
from dpl.fem.sparse import (
    Array,
    Backend,
    Factor,
    Pattern,
    SingularMatrix,
    full_matrix,
    require_finite,
    row_numbers,
)
from dpl.version import install

__all__ = [
    "BACKENDS",
    "Backend",
    "Factor",
    "Pardiso",
    "SingularMatrix",
    "SuperLU",
    "backend",
    "chosen",
    "full_matrix",
    "installed",
    "slow_blas",
]


def installed() -> list[str]:
    """Return the names of the backends that can be used here."""
    missing = set() if importlib.util.find_spec("pypardiso") else {"pardiso"}
    return [name for name in BACKENDS if name not in missing]


def backend(pattern: Pattern, name: str = "auto", near_null: Array | None = None) -> Backend:
    """Return a backend for matrices of a pattern.

    Args:
        pattern: Structure of the matrices.
        name: "band", "band32", "pardiso", "superlu", "cg", or "auto", see `chosen`.
        near_null: Fields that cost no energy, (n, k), see `Body.near_null`; "cg" wants them.

    Raises:
        ValueError: No such backend, or it is not installed.
    """
    return BACKENDS[chosen(name, pattern, near_null)](pattern, near_null)


def chosen(
    name: str,
    pattern: Pattern | None = None,
    near_null: Array | None = None,
    *,
    lasting: bool = False,
) -> str:
    """Return the name of the backend that a name stands for.

    "auto" depends on the pattern and on what is installed, never on a clock: it stays "auto"
    where no pattern is given.

    Args:
        name: As for `backend`.
        pattern: Structure of the matrices.
        near_null: Fields that cost no energy, (n, k), see `Body.near_null`.
        lasting: One factor is to answer many right-hand sides: it may cost more if they cost less.

    Raises:
        ValueError: No such backend, or it is not installed.
    """
    if name not in (*BACKENDS, "auto"):
        raise ValueError(f"linear = {name!r} must be auto, {', '.join(BACKENDS)}")
    if name != "auto" and name not in installed():
        raise ValueError(f"linear = {name!r} is not installed: {install(name)}")
    return name if name != "auto" or pattern is None else _automatic(pattern, near_null, lasting)


# Measured on beams, cubes, stars, plates of 1,000 to 100,000 degrees of freedom: a band costs n b^2
# operations, a sparse factor of a solid about n^2 slower ones, so b^2 / n decides.
PAYS = {"pardiso": 22, "superlu": 100, "cg": 10}  # b^2 / n below which a band is faster
MULTIGRID = {"pardiso": 100_000, "superlu": 30_000}  # n from which on multigrid is faster
LASTING = 3.0  # times that where one factor answers many right-hand sides: it must fit in memory
WIDE = 250  # b from which on float32 saves more than the iterations on it cost


def _automatic(pattern: Pattern, near_null: Array | None, lasting: bool) -> str:
    names = installed()
    sparse = "pardiso" if "pardiso" in names else "superlu"
    multigrid = "cg" in names and near_null is not None and multigrid_installed()
    large = MULTIGRID[sparse] * (LASTING if lasting else 1)
    best = "cg" if multigrid and pattern.size > large else sparse
    if "band" in names:
        half = band_layout(pattern).half
        if half**2 < PAYS[best] * pattern.size:
            # In float32 factorising is faster, a solve to all digits is not.
            return "band32" if half >= WIDE and not lasting else "band"
    return best


def _indefinite(pattern: Pattern) -> Backend:
    """Return the best backend for matrices that are not positive definite."""
    return Pardiso(pattern) if "pardiso" in installed() else SuperLU(pattern)


@dataclass(frozen=True, eq=False)
class SuperLUFactor:
    """LDL^T-like factor in a fill-reducing order."""

    lu: Any
    order: NDArray[np.int_]

    @cached_property
    def negative_pivots(self) -> int:
        """Number of negative eigenvalues (Sylvester's law of inertia; diagonal pivots only)."""
        return int((self.lu.U.diagonal() < 0).sum())

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), with K x = right."""
        x = np.empty_like(right)
        x[self.order] = self.lu.solve(right[self.order])
        return x

    def apply(self, right: Array) -> Array:
        """Return `solve`."""
        return self.solve(right)


@dataclass(frozen=True, eq=False)
class SuperLU:
    """SciPy's SuperLU in symmetric mode (Li, Demmel 2003): on every machine."""

    pattern: Pattern

    @cached_property
    def _plan(self) -> tuple[NDArray[np.int_], csc_array, NDArray[np.int_]]:
        """Minimum-degree order, structure of the reordered matrix, where its entries come from."""
        n, count = self.pattern.size, len(self.pattern.indices)
        rows, columns = row_numbers(self.pattern), self.pattern.indices
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
        require_finite(values)
        order, structure, source = self._plan
        matrix = csc_array((values[source], structure.indices, structure.indptr), structure.shape)
        try:
            return SuperLUFactor(splu(matrix, **_symmetric("NATURAL")), order)
        except RuntimeError as error:
            raise SingularMatrix(str(error)) from error


def _symmetric(order: str) -> dict[str, Any]:
    """Return the settings for which SuperLU keeps to diagonal pivots."""
    return {"permc_spec": order, "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


@dataclass(frozen=True, eq=False)
class PardisoFactor:
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

BACKENDS: dict[str, Callable[[Pattern, Array | None], Backend]] = {
    "band": lambda pattern, near_null: Band(pattern, _indefinite),
    "band32": lambda pattern, near_null: Band32(pattern, _indefinite),
    "pardiso": lambda pattern, near_null: Pardiso(pattern),
    "superlu": lambda pattern, near_null: SuperLU(pattern),
    "cg": CG,
}

# flag of the CPU -> its OpenBLAS kernels, best first; those that OpenBLAS takes for unknown CPUs
KERNELS = {"avx512dq": "SkylakeX", "avx2": "Haswell"}
CPUINFO = Path("/proc/cpuinfo")
OLD_KERNELS = {"generic", "prescott", "core2", "penryn", "dunnington", "atom", "nehalem"}


def slow_blas() -> str | None:
    """Return one line of advice if OpenBLAS has not recognised this CPU, else None."""
    if "OPENBLAS_CORETYPE" in os.environ or not CPUINFO.exists():
        return None
    lines = CPUINFO.read_text().splitlines()
    flags = next((line.split() for line in lines if line.startswith("flags")), [])
    best = next((kernels for flag, kernels in KERNELS.items() if flag in flags), None)
    for library in threadpool_info():
        kernels = str(library.get("architecture", ""))
        if library["internal_api"] == "openblas" and best and kernels.lower() in OLD_KERNELS:
            return (
                f"OpenBLAS runs its {kernels} kernels on a CPU that can do more: "
                f"set OPENBLAS_CORETYPE={best} before Python starts"
            )
    return None

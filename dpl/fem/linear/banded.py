"""Banded Cholesky factors by LAPACK, the fastest direct solver for slender bodies."""

import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numba import float32, float64, njit
from numba.types import Array as Typed
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpbtrf, spbtrf

from dpl.fem.linear.interface import (
    Array,
    Backend,
    Factor,
    Pattern,
    SingularMatrix,
    SymmetricProduct,
    require_finite,
)
from dpl.fem.linear.krylov import conjugate_gradients
from dpl.fem.linear.ordering import BandStorage, band_storage
from dpl.system.threads import blas

BLOCK = 64  # columns of a factor in a matrix product


@njit(
    [
        float64[::1](Typed(float64, 2, "C", readonly=True), Typed(float64, 1, "C", readonly=True)),
        float32[::1](Typed(float32, 2, "C", readonly=True), Typed(float32, 1, "C", readonly=True)),
    ],
    cache=True,
    fastmath={"reassoc", "contract"},  # allows sums in vector registers
)
def banded_triangular_solve(L, right):  # type: ignore[no-untyped-def]
    """Return x, (n,), with L L^T x = right, four columns of L at a time.

    LAPACK's xPBTRS reads and writes x once per column; this loop does so once per four columns.

    Args:
        L: Storage of the factor, (n, b + 1), see `BandedFactor`; zero beyond the last row.
        right: Right-hand side, (n,), of the same dtype.
    """
    n, w = L.shape
    x = np.zeros(n + w + 3, L.dtype)
    x[:n] = right
    whole = n - n % 4 if w > 3 else 0
    for j in range(0, whole, 4):
        p, q, r, s = L[j], L[j + 1], L[j + 2], L[j + 3]
        a = x[j] / p[0]
        b = (x[j + 1] - p[1] * a) / q[0]
        c = (x[j + 2] - p[2] * a - q[1] * b) / r[0]
        d = (x[j + 3] - p[3] * a - q[2] * b - r[1] * c) / s[0]
        x[j], x[j + 1], x[j + 2], x[j + 3] = a, b, c, d
        below = x[j + 4 :]
        for k in range(w - 4):
            below[k] -= p[k + 4] * a + q[k + 3] * b + r[k + 2] * c + s[k + 1] * d
        for k in range(max(w - 4, 0), w - 1):
            below[k] -= s[k + 1] * d
            if k + 2 < w:
                below[k] -= r[k + 2] * c
            if k + 3 < w:
                below[k] -= q[k + 3] * b
    for j in range(whole, n):
        x[j] /= L[j, 0]
        for k in range(1, w):
            x[j + k] -= L[j, k] * x[j]
    x[n:] = 0
    for j in range(n - 1, whole - 1, -1):
        for k in range(1, w):
            x[j] -= L[j, k] * x[j + k]
        x[j] /= L[j, 0]
    for j in range(whole - 4, -1, -4):
        p, q, r, s = L[j], L[j + 1], L[j + 2], L[j + 3]
        a, b, c, d = x[j], x[j + 1], x[j + 2], x[j + 3]
        below = x[j + 4 :]
        for k in range(w - 4):
            a -= p[k + 4] * below[k]
            b -= q[k + 3] * below[k]
            c -= r[k + 2] * below[k]
            d -= s[k + 1] * below[k]
        for k in range(max(w - 4, 0), w - 1):
            d -= s[k + 1] * below[k]
            if k + 2 < w:
                c -= r[k + 2] * below[k]
            if k + 3 < w:
                b -= q[k + 3] * below[k]
        d /= s[0]
        c = (c - r[1] * d) / r[0]
        b = (b - q[1] * c - q[2] * d) / q[0]
        a = (a - p[1] * b - p[2] * c - p[3] * d) / p[0]
        x[j], x[j + 1], x[j + 2], x[j + 3] = a, b, c, d
    return x[:n].copy()


def banded_block_solve(L: NDArray[Any], x: NDArray[Any]) -> None:
    """Replace x (n, k) by the solution of L L^T x = right-hand sides, k at once.

    Blocks of columns of L become dense matrices, so that matrix products do the work and L is read
    once for all right-hand sides.

    Args:
        L: Storage of the factor, (n, b + 1), see `BandedFactor`; zero beyond the last row.
        x: Right-hand sides, (n, k), of the same dtype.
    """
    n, width = L.shape
    starts = range(0, n, BLOCK)
    for start in starts:
        panel = _dense_columns(L[start : start + BLOCK])
        m = len(panel)
        own, below = x[start : start + m], x[start + m : start + m + width - 1]
        own[:] = solve_triangular(panel[:, :m], own, trans="T", check_finite=False)
        below -= panel[:, m : m + len(below)].T @ own
    for start in reversed(starts):
        panel = _dense_columns(L[start : start + BLOCK])
        m = len(panel)
        own, below = x[start : start + m], x[start + m : start + m + width - 1]
        own -= panel[:, m : m + len(below)] @ below
        own[:] = solve_triangular(panel[:, :m], own, check_finite=False)


def _dense_columns(L: NDArray[Any]) -> NDArray[Any]:
    """Return m columns of a factor as dense rows, (m, m + b), the first m of them triangular.

    Args:
        L: Storage of these columns, (m, b + 1).
    """
    m, width = L.shape
    padded = np.zeros((m, width + m), L.dtype)
    padded[:, :width] = L
    length = m + width - 1  # one less than a row of `padded`: each row moves one place to the right
    return padded.ravel()[: m * length].reshape(m, length)


@dataclass(frozen=True, eq=False)
class BandedFactor(Factor):
    """Banded Cholesky factor L of a positive definite matrix.

    Attributes:
        storage: L, (n, b + 1), see `BandStorage`.
        order: Order of the unknowns, see `BandStorage`.
        negative_pivots: 0.
    """

    storage: NDArray[Any]
    order: NDArray[np.int32] | None
    negative_pivots: int = 0

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), with K x = right, to the rounding of the storage."""
        ordered = right if self.order is None else right[self.order]
        ordered = np.ascontiguousarray(ordered, self.storage.dtype)
        x = np.empty_like(right)
        x[... if self.order is None else self.order] = banded_triangular_solve(
            self.storage, ordered
        )
        return x

    def solve_many(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return the solutions, (k, n), to the rounding of the storage, see `Factor.solve_many`."""
        size = np.abs(right).max(axis=1, keepdims=True, initial=0)
        size[size == 0] = 1
        order = slice(None) if self.order is None else self.order
        ordered = np.ascontiguousarray((right / size)[:, order].T, self.storage.dtype)
        banded_block_solve(self.storage, ordered)
        x = np.empty_like(right)
        x[:, order] = ordered.T
        return x * size

    def to_float32(self) -> "BandedFactor":
        """Return the factor in float32, in half the memory."""
        return replace(self, storage=self.storage.astype(np.float32))


class BandedCholesky:
    """Banded Cholesky in float64; another backend factorises indefinite matrices.

    Source: Anderson et al. (1999), LAPACK Users' Guide, xPBTRF.
    """

    dtype: type[np.floating[Any]] = np.float64

    def __init__(self, pattern: Pattern, indefinite: Callable[[Pattern], Backend]) -> None:
        """Store the pattern, and a constructor of a backend for indefinite matrices."""
        self.pattern, self.indefinite = pattern, indefinite
        self._storage: NDArray[Any] | None = None
        self._last: Callable[[], BandedFactor | None] = lambda: None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without storage."""
        return type(self), (self.pattern, self.indefinite)

    @cached_property
    def layout(self) -> BandStorage:
        """Order and places of the entries."""
        return band_storage(self.pattern)

    @cached_property
    def other(self) -> Backend:
        """The backend for matrices that are not positive definite."""
        return self.indefinite(self.pattern)

    def factorise(self, values: Array) -> Factor:
        """Return the factor, see `Backend.factorise`."""
        require_finite(values)
        return self._cholesky(values) or self.other.factorise(values)

    def factorise_definite(self, values: Array) -> Factor:
        """Return the factor, see `DefiniteBackend`."""
        require_finite(values)
        if (factor := self._cholesky(values)) is None:
            raise SingularMatrix("the matrix is not positive definite")
        return factor

    def _cholesky(self, values: Array) -> BandedFactor | None:
        """Return the factor; None if the matrix may not be positive definite."""
        layout = self.layout
        if self._storage is None or self._last() is not None:  # still used by a factor
            self._storage = np.empty((self.pattern.size, layout.half + 1), self.dtype)
        storage = self._storage
        storage.fill(0)  # the last factorisation has filled the whole band
        storage.ravel()[layout.place] = values.astype(self.dtype, copy=False)
        diagonal = storage[:, 0].copy()
        factorise = dpbtrf if self.dtype == np.float64 else spbtrf
        with blas().limit(limits=1):
            lower, info = factorise(storage.T, lower=1, overwrite_ab=1)
        if info or (storage[:, 0] ** 2 <= 4 * np.finfo(self.dtype).eps * diagonal).any():
            return None
        factor = BandedFactor(lower.T, layout.order)
        self._last = weakref.ref(factor)
        return factor


class MixedPrecisionBandedCholesky(BandedCholesky):
    """Banded Cholesky in float32 as preconditioner of conjugate gradients in float64.

    It takes half the time and memory of `BandedCholesky`, which replaces it where float32 is not
    accurate enough. Diagonal scaling would not help (Demmel 1989).
    """

    dtype = np.float32

    @cached_property
    def other(self) -> BandedCholesky:
        """Backend in float64."""
        exact = BandedCholesky(self.pattern, self.indefinite)
        exact.layout = self.layout
        return exact

    def factorise(self, values: Array) -> Factor:
        """Return the factor, see `Backend.factorise`."""
        return self._mixed(values) or self.other.factorise(values)

    def factorise_definite(self, values: Array) -> Factor:
        """Return the factor, see `DefiniteBackend`."""
        return self._mixed(values) or self.other.factorise_definite(values)

    def _mixed(self, values: Array) -> "MixedPrecisionFactor | None":
        """Return the factor; None if the matrix may not be positive definite in float32."""
        require_finite(values)
        diagonal = np.abs(values[self.pattern.indptr[:-1]])
        scale = float(np.sqrt(diagonal.max(initial=0)) * np.sqrt(diagonal.min(initial=np.inf)))
        if not 0 < scale < np.inf:
            return None
        with np.errstate(over="ignore"):
            rough = self._cholesky(values / scale)
        if rough is None:
            return None
        return MixedPrecisionFactor(self, values.copy(), rough, scale)


class MixedPrecisionFactor(Factor):
    """A matrix with its factor in float32, and one in float64 after a solve that needed it."""

    MAX_ITER = 25  # more iterations cost more than a float64 factor

    def __init__(
        self, parent: MixedPrecisionBandedCholesky, values: Array, rough: BandedFactor, scale: float
    ) -> None:
        """Store the entries (nnz,) and the factor of entries / scale."""
        self.parent, self.values, self.rough, self.scale = parent, values, rough, scale
        self.product = SymmetricProduct(parent.pattern, values)
        self.exact: Factor | None = None

    @property
    def negative_pivots(self) -> int:
        """Negative pivots of the float64 factor, 0 while there is none."""
        return 0 if self.exact is None else self.exact.negative_pivots or 0

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), see `Factor.solve`."""
        if self.exact is None:
            try:
                return conjugate_gradients(self.product, self.apply, right, rtol, self.MAX_ITER)
            except SingularMatrix:
                self.exact = self.parent.other.factorise(self.values)
        return self.exact.solve(right)

    def apply(self, right: Array) -> Array:
        """Return K^-1 right, (n,), in the accuracy of float32."""
        size = np.abs(right).max() or 1.0  # of order one, so that float32 holds it
        rough = self.rough.solve((right / size).astype(np.float32)).astype(np.float64)
        return rough * (size / self.scale)

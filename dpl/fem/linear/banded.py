"""Banded Cholesky factors by LAPACK, the fastest direct solver for slender bodies."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpbtrf, dpbtrs, spbtrf, spbtrs

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
MAX_ITER = 25  # of conjugate gradients; more cost more than a float64 factor


def banded_block_solve(L: NDArray[Any], x: NDArray[Any]) -> None:
    """Replace right-hand sides x (n, k) by the solutions of L L^T x = right, k at once.

    Blocks of columns of the factor L (n, b + 1), see `BandedFactor`, become dense matrices, so that
    matrix products do the work and L is read once. L is zero beyond the last row.
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
    """Return m columns of a factor (m, b + 1) as rows, (m, m + b), the first m triangular."""
    m, width = L.shape
    padded = np.zeros((m, width + m), L.dtype)
    padded[:, :width] = L
    length = m + width - 1  # one less than a row of `padded`: each row moves one place to the right
    return padded.ravel()[: m * length].reshape(m, length)


@dataclass(frozen=True, eq=False)
class BandedFactor(Factor):
    """Banded Cholesky factor L of a positive definite matrix."""

    storage: NDArray[Any]  # L, (n, b + 1), see `BandStorage`
    order: NDArray[np.int32]  # order of the unknowns, see `BandStorage`
    negative_pivots: int = 0

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), to the rounding of the storage, see `Factor.solve`."""
        ordered = np.ascontiguousarray(right[self.order], self.storage.dtype)
        solve = dpbtrs if self.storage.dtype == np.float64 else spbtrs
        x = np.empty_like(right)
        x[self.order] = solve(self.storage.T, ordered, lower=1)[0].ravel()
        return x

    def solve_many(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return the solutions, (k, n), to the rounding of the storage, see `Factor.solve_many`."""
        size = np.abs(right).max(axis=1, keepdims=True, initial=0)
        size[size == 0] = 1
        ordered = np.ascontiguousarray((right / size)[:, self.order].T, self.storage.dtype)
        banded_block_solve(self.storage, ordered)
        x = np.empty_like(right)
        x[:, self.order] = ordered.T
        return x * size


class BandedCholesky:
    """Banded Cholesky in float64; another backend factorises indefinite matrices.

    Source: Anderson et al. (1999), LAPACK Users' Guide, xPBTRF.
    """

    dtype: type[np.floating[Any]] = np.float64

    def __init__(self, pattern: Pattern, indefinite: Callable[[Pattern], Backend]) -> None:
        """Store the pattern, and a constructor of a backend for indefinite matrices."""
        self.pattern, self._make_indefinite = pattern, indefinite

    @cached_property
    def layout(self) -> BandStorage:
        """Order and places of the entries."""
        return band_storage(self.pattern)

    @cached_property
    def indefinite(self) -> Backend:
        """The backend for matrices that are not positive definite."""
        return self._make_indefinite(self.pattern)

    def factorise(self, values: Array) -> Factor:
        """Return the factor, see `Backend.factorise`."""
        return self.definite(values) or self.indefinite.factorise(values)

    def definite(self, values: Array) -> Factor | None:
        """Return the factor; None if the matrix may not be positive definite, see `Backend`."""
        require_finite(values)
        layout = self.layout
        storage = np.zeros((self.pattern.size, layout.half + 1), self.dtype)
        storage.ravel()[layout.place] = values.astype(self.dtype, copy=False)
        diagonal = storage[:, 0].copy()
        factorise = dpbtrf if self.dtype == np.float64 else spbtrf
        with blas().limit(limits=1):
            lower, info = factorise(storage.T, lower=1, overwrite_ab=1)
        if info or (storage[:, 0] ** 2 <= 4 * np.finfo(self.dtype).eps * diagonal).any():
            return None
        return BandedFactor(lower.T, layout.order)


class MixedPrecisionBandedCholesky(BandedCholesky):
    """Banded Cholesky in float32 as preconditioner of conjugate gradients in float64.

    It takes half the time and memory of `BandedCholesky`, which replaces it where float32 is not
    accurate enough. Diagonal scaling would not help (Demmel 1989).
    """

    dtype = np.float32

    @cached_property
    def exact(self) -> BandedCholesky:
        """Backend in float64."""
        exact = BandedCholesky(self.pattern, self._make_indefinite)
        exact.layout = self.layout
        return exact

    def definite(self, values: Array) -> Factor | None:
        """Return the factor; None if the matrix may not be positive definite, see `Backend`."""
        diagonal = np.abs(values[self.pattern.indptr[:-1]])
        scale = float(np.sqrt(diagonal.max(initial=0)) * np.sqrt(diagonal.min(initial=np.inf)))
        if 0 < scale < np.inf:
            with np.errstate(over="ignore"):
                rough = super().definite(values / scale)
            if rough is not None:
                return MixedPrecisionFactor(self, values.copy(), rough, scale)
        return self.exact.definite(values)


@dataclass(eq=False)
class MixedPrecisionFactor(Factor):
    """A matrix with its factor in float32, and one in float64 after a solve that needed it."""

    parent: MixedPrecisionBandedCholesky  # the backend
    values: Array  # entries of the matrix, (nnz,)
    rough: Factor  # factor of the entries over `scale`
    scale: float  # size of the entries
    exact: Factor | None = None  # factor in float64, once needed

    @cached_property
    def product(self) -> SymmetricProduct:
        """The product with the matrix."""
        return SymmetricProduct(self.parent.pattern, self.values)

    @property
    def negative_pivots(self) -> int | None:
        """Negative pivots of the float64 factor, 0 while there is none."""
        return 0 if self.exact is None else self.exact.negative_pivots

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), see `Factor.solve`."""
        if self.exact is None:
            try:
                return conjugate_gradients(self.product, self.apply, right, rtol, MAX_ITER)
            except SingularMatrix:
                definite = self.parent.exact.definite(self.values)
                self.exact = definite or self.parent.indefinite.factorise(self.values)
        return self.exact.solve(right)

    def apply(self, right: Array) -> Array:
        """Return K^-1 right, (n,), in the accuracy of float32."""
        size = np.abs(right).max() or 1.0  # of order one, so that float32 holds it
        rough = self.rough.solve((right / size).astype(np.float32)).astype(np.float64)
        return rough * (size / self.scale)

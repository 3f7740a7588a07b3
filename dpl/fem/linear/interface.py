"""Interface of the linear backends, their exception, products with symmetric matrices."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, triu

Array = NDArray[np.float64]


class Pattern(Protocol):
    """Sparsity pattern of a symmetric matrix: the upper triangle in CSR.

    Every row starts with its diagonal entry, and columns are sorted.
    """

    @property
    def size(self) -> int:
        """n, the number of rows."""

    @property
    def indptr(self) -> NDArray[np.int32]:
        """Start of each row among the entries, (n + 1,)."""

    @property
    def indices(self) -> NDArray[np.int32]:
        """Column of each entry, (nnz,)."""


class SingularMatrix(ArithmeticError):
    """The matrix has no usable factorisation, or an iterative solve does not converge."""


BLOCK = 8  # right-hand sides of one step of a compliance
UNKNOWN = -1  # number of negative eigenvalues that is not known


class Factor(ABC):
    """A factorised matrix K, or the matrix and its preconditioner in an iterative backend.

    A direct backend implements `solve` and `negative_pivots`, an iterative one `solve` and `apply`.
    """

    @property
    def negative_pivots(self) -> int | None:
        """Number of negative eigenvalues; None where the backend does not count them."""
        return None

    @property
    def stability(self) -> int:
        """Number of negative eigenvalues; 1 for any number, `UNKNOWN` for no knowledge.

        Iterative backends may need a linear solve for it.
        """
        return UNKNOWN if self.negative_pivots is None else self.negative_pivots

    def apply(self, right: Array) -> Array:
        """Return an approximation of K^-1 right, (n,), by a fixed symmetric preconditioner."""
        return self.solve(right)

    @abstractmethod
    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), with K x = right.

        Iterative backends stop at ||right - K x|| <= rtol ||right||, and raise a `SingularMatrix`
        if they find negative curvature or do not converge. Direct ones solve to rounding.
        """

    def solve_many(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return the solutions, (k, n), of right-hand sides (k, n), see `solve`."""
        return np.array([self.solve(row, rtol) for row in right]).reshape(right.shape)

    def compliance_steps(
        self, places: NDArray[np.int64], out: Array, size: int, rtol: float
    ) -> Iterator[None]:
        """Set `out` (m, m), zeros, to the entries of K^-1, (n, n), at some places in short steps.

        `size` is n; see `solve` for `rtol`.
        """
        for rows in np.split(np.arange(len(places)), range(BLOCK, len(places), BLOCK)):
            right = np.zeros((len(rows), size))
            right[np.arange(len(rows)), places[rows]] = 1.0
            out[rows] = self.solve_many(right, rtol)[:, places]
            yield


class Backend(Protocol):
    """Factorisation of matrices of one pattern, on one thread. Pickling omits the factors.

    A backend that detects indefinite matrices at less cost than it factorises them has a method
    `definite`, which returns the factor, or None if the matrix may not be positive definite.
    """

    def factorise(self, values: Array) -> Factor:
        """Return the factor of the matrix with entries `values` (nnz,) on the pattern.

        The factor stays valid when the backend factorises other matrices and when `values` change.

        Raises:
            SingularMatrix: A pivot is exactly zero, or entries are not finite.
        """


class SymmetricProduct:
    """Product K x from the upper triangle of K."""

    def __init__(self, pattern: Pattern, values: Array) -> None:
        """Store the entries (nnz,) without a copy."""
        entries = values, pattern.indices, pattern.indptr
        self.upper = csr_array(entries, shape=(pattern.size,) * 2)
        self.lower = self.upper.T  # a view
        self.diagonal = values[pattern.indptr[:-1]]

    def __call__(self, x: Array) -> Array:
        """Return K x, (n,)."""
        product = self.upper @ x
        product += self.lower @ x
        product -= self.diagonal * x
        return product


def full_matrix(pattern: Pattern, values: Array) -> csr_array:
    """Return the full symmetric matrix (n, n) of upper-triangle entries (nnz,)."""
    upper = csr_array((values, pattern.indices, pattern.indptr), shape=(pattern.size,) * 2)
    return (upper + triu(upper, 1).T).tocsr()


def row_numbers(pattern: Pattern) -> NDArray[np.int32]:
    """Return the row of each entry, (nnz,)."""
    return np.repeat(np.arange(pattern.size, dtype=np.int32), np.diff(pattern.indptr))


def require_finite(values: Array) -> None:
    """Raise `SingularMatrix` unless all entries are finite."""
    if not np.isfinite(values).all():
        raise SingularMatrix("the matrix has entries that are not finite")

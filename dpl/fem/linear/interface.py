"""Interface of the linear backends, their exception, products with symmetric matrices."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

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


class Stability(NamedTuple):
    """Number of negative eigenvalues of a symmetric matrix, as far as it is known.

    Attributes:
        least: Lower bound of the number.
        exact: Whether the bound is the number itself.
    """

    least: int
    exact: bool

    @property
    def negative_pivots(self) -> int:
        """The bound as `Solution.negative_pivots` stores it; -1 where nothing is known."""
        return self.least if self.least or self.exact else -1


UNKNOWN = Stability(0, exact=False)
UNSTABLE = Stability(1, exact=False)  # some eigenvalues are negative or zero, not counted


class Factor(Protocol):
    """A factorised matrix, or the matrix and its preconditioner in an iterative backend."""

    @property
    def negative_pivots(self) -> int | None:
        """Number of negative eigenvalues; None where the backend does not count them."""

    def stability(self) -> Stability:
        """Return the known bound of the number of negative eigenvalues.

        Iterative backends need a linear solve for it.
        """

    def apply(self, right: Array) -> Array:
        """Return an approximation of K^-1 right, (n,), by a fixed symmetric preconditioner."""

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), with K x = right.

        Args:
            right: Right-hand side, (n,).
            rtol: ||right - K x|| / ||right|| at which iterative backends stop [-]; direct ones
                solve to rounding.

        Raises:
            SingularMatrix: An iterative backend found negative curvature or did not converge.
        """

    def solve_many(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return the solutions, (k, n), of right-hand sides (k, n), see `solve`."""


class SolvesOneByOne:
    """Base of factors that solve for several right-hand sides one after the other."""

    def solve_many(self: Factor, right: Array, rtol: float = 1e-12) -> Array:
        """Return the solutions, (k, n), see `Factor.solve_many`."""
        solutions = np.empty_like(right)
        for row, one in zip(solutions, right, strict=True):
            row[:] = self.solve(one, rtol)
        return solutions


class DirectFactor(SolvesOneByOne):
    """Base of the factors that count negative pivots and whose solves are exact to rounding."""

    def apply(self: Factor, right: Array) -> Array:
        """Return `solve`."""
        return self.solve(right)

    def stability(self: Factor) -> Stability:
        """Return the number of negative pivots."""
        return Stability(self.negative_pivots or 0, exact=True)


class IterativeFactor(SolvesOneByOne):
    """Base of the factors that count no pivots: the stability of an equilibrium is unknown."""

    negative_pivots: None = None

    def stability(self) -> Stability:
        """Return `UNKNOWN`."""
        return UNKNOWN


class Backend(Protocol):
    """Factorisation of matrices of one pattern, on one thread. Pickling omits the factors."""

    def factorise(self, values: Array) -> Factor:
        """Return the factor of the matrix with entries `values` (nnz,) on the pattern.

        The factor stays valid when the backend factorises other matrices and when `values` change.

        Raises:
            SingularMatrix: A pivot is exactly zero, or entries are not finite.
        """


@runtime_checkable
class DefiniteBackend(Protocol):
    """Backend that refuses indefinite matrices at less cost than it factorises them."""

    def factorise_definite(self, values: Array) -> Factor:
        """Return the factor of a positive definite matrix, see `Backend.factorise`.

        Raises:
            SingularMatrix: The matrix is not positive definite.
        """


class SymmetricProduct:
    """Product K x from the upper triangle of K."""

    def __init__(self, pattern: Pattern, values: Array) -> None:
        """Store the entries (nnz,) without a copy."""
        shape = (pattern.size, pattern.size)
        self.upper = csr_array((values, pattern.indices, pattern.indptr), shape=shape)
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
    lower = upper.T.tocsr()
    lower.setdiag(0)
    lower.eliminate_zeros()
    return (upper + lower).tocsr()


def row_numbers(pattern: Pattern) -> NDArray[np.int32]:
    """Return the row of each entry, (nnz,)."""
    return np.repeat(np.arange(pattern.size, dtype=np.int32), np.diff(pattern.indptr))


def require_finite(values: Array) -> None:
    """Raise `SingularMatrix` unless all entries are finite."""
    if not np.isfinite(values).all():
        raise SingularMatrix("the matrix has entries that are not finite")

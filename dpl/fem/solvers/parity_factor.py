"""Factor of K(0) by parity: one banded Cholesky factor for the fields of each parity.

K(0) maps fields of one parity to forces of the same parity, see `dpl.fem.parity`. With M
symmetries the factors have about M times fewer entries than that of the whole matrix, and a solve
reads as many fewer.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, triu
from torch import Tensor

from dpl.fem.linear.banded import (
    BandedCholesky,
    BandedFactor,
    banded_block_solve,
    banded_triangular_solve,
)
from dpl.fem.linear.interface import (
    Array,
    Backend,
    DirectFactor,
    Pattern,
    SingularMatrix,
    full_matrix,
)
from dpl.fem.linear.ordering import band_storage
from dpl.fem.parity import Parities, SignedOrbits
from dpl.fem.problem import Problem
from dpl.fem.symmetry import Symmetry


@dataclass(frozen=True, eq=False)
class ParityFactor(DirectFactor):
    """Banded Cholesky factors of K(0) for one value of each of m orbits, M parities.

    Attributes:
        storage: Rows of the factors in float32, (M, m, b + 1), see `BandedFactor`.
        order: Orbit of each row, (m,).
        orbits: Degrees of freedom of each orbit.
        characters: Factor of each parity under each symmetry, (M, M).
        negative_pivots: 0.
    """

    storage: NDArray[np.float32]
    order: NDArray[np.int64]
    orbits: SignedOrbits
    characters: Tensor
    negative_pivots: int = 0

    @classmethod
    def of(cls, problem: Problem, group: Sequence[Symmetry]) -> Self:
        """Factorise K(0) of a body.

        Raises:
            SingularMatrix: K(0) is not positive definite.
        """
        parities = Parities.of(group, problem.shape[1])
        orbits = SignedOrbits.of_field(parities, group, problem.free)
        whole = full_matrix(problem.pattern, problem.stiffness_at_rest().numpy())
        blocks = [_block(whole, orbits, characters) for characters in parities.characters]
        pattern = _UpperPattern.of(blocks)
        backend = BandedCholesky(pattern, _refuse)
        backend.layout = band_storage(pattern)
        factors = [backend.factorise(pattern.values(block)) for block in blocks]
        storage = [one.storage for one in factors if isinstance(one, BandedFactor)]
        order = backend.layout.order
        rows = np.arange(pattern.size) if order is None else order.astype(np.int64)
        return cls(np.stack(storage).astype(np.float32), rows, orbits, parities.characters)

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), with K x = right, in the accuracy of float32."""
        size = np.abs(right).max(initial=0) or 1.0  # of order one, so that float32 holds it
        images, signs, scales, characters = self._arrays
        parts = (characters @ (scales * (right / size)[images])).astype(np.float32)
        solved = np.empty(parts.shape)
        for p, part in enumerate(parts):
            solved[p, self.order] = banded_triangular_solve(self.storage[p], part[self.order])
        x = np.empty_like(right)
        x[images] = size * (signs * (characters.T @ solved))
        return x

    def solve_many(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return the solutions, (k, n), in the accuracy of float32, see `Factor.solve_many`."""
        size = np.abs(right).max(axis=1, keepdims=True, initial=0)
        size[size == 0] = 1
        images, signs, scales, characters = self._arrays
        parts = characters @ (scales * (right / size)[:, images])  # (k, M, m)
        solved = np.empty_like(parts)
        for p, storage in enumerate(self.storage):
            own = np.ascontiguousarray(parts[:, p, self.order].T, np.float32)
            banded_block_solve(storage, own)
            solved[:, p, self.order] = own.T
        x = np.empty_like(right)
        x[:, images] = signs * (characters.T @ solved)
        return x * size

    @cached_property
    def _arrays(self) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """Images and signs of the orbits, signs times weights, (M, m), and the characters."""
        images, signs, weights = (part.numpy() for part in self.orbits)
        return images, signs, signs * weights, self.characters.numpy()


def _block(whole: csr_array, orbits: SignedOrbits, characters: Tensor) -> csr_array:
    """Return C^T K C, (m, m), of the fields C of one parity, one for each orbit.

    The field of an orbit that the parity does not allow is zero; it gets a one on the diagonal.
    """
    count = len(orbits.weight)
    values = characters[:, None] * orbits.sign * orbits.weight
    columns = np.tile(np.arange(count), len(characters))
    places = orbits.images.flatten().numpy(), columns
    shape = whole.shape[0], count
    fields = coo_array((values.flatten().numpy(), places), shape=shape).tocsr()
    squares = np.asarray(fields.power(2).sum(axis=0)).ravel()
    missing = np.flatnonzero(squares < 1e-6)
    ones = coo_array((np.ones(len(missing)), (missing, missing)), shape=(count, count))
    return (fields.T @ whole @ fields + ones).tocsr()


class _UpperPattern(NamedTuple):
    """Sparsity pattern that contains those of several symmetric matrices, see `Pattern`."""

    size: int
    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]

    @classmethod
    def of(cls, matrices: list[csr_array]) -> Self:
        union = triu(sum(abs(matrix) for matrix in matrices), format="csr")
        union.sort_indices()
        return cls(union.shape[0], union.indptr, union.indices)

    def values(self, matrix: csr_array) -> NDArray[np.float64]:
        """Return the entries of a matrix on the pattern, (nnz,)."""
        rows = np.repeat(np.arange(self.size), np.diff(self.indptr))
        return np.asarray(matrix[rows, self.indices], dtype=np.float64).ravel()


def _refuse(pattern: Pattern) -> Backend:
    raise SingularMatrix("K(0) is not positive definite")

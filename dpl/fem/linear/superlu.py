"""Sparse LU factors by SuperLU (Li 2005, ACM Trans. Math. Softw. 31), part of SciPy."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from dpl.fem.linear.interface import (
    Array,
    Factor,
    Pattern,
    SingularMatrix,
    full_matrix,
    require_finite,
)

# Settings with which SuperLU pivots on the diagonal.
ON_DIAGONAL: dict[str, Any] = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


@dataclass(frozen=True, eq=False)
class SuperLUFactor(Factor):
    """LDL^T-like factor in a fill-reducing order."""

    lu: Any
    order: NDArray[np.int_]

    @cached_property
    def negative_pivots(self) -> int:
        """Number of negative eigenvalues (Sylvester's law of inertia; diagonal pivots only)."""
        return int((self.lu.U.diagonal() < 0).sum())

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), with K x = right."""
        return self.solve_many(right[None])[0]

    def solve_many(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return the solutions, (k, n), see `Factor.solve_many`."""
        x = np.empty_like(right)
        x[:, self.order] = self.lu.solve(np.ascontiguousarray(right[:, self.order].T)).T
        return x


@dataclass(frozen=True, eq=False)
class SuperLU:
    """SuperLU in symmetric mode, which is always installed.

    Source: Li, Demmel (2003), ACM Trans. Math. Softw. 29.
    """

    pattern: Pattern

    @cached_property
    def _plan(self) -> tuple[NDArray[np.int_], csc_array, NDArray[np.int_]]:
        """Minimum-degree order, structure of the reordered matrix, source of each entry."""
        count = len(self.pattern.indices)
        model = np.full(count, -1.0)  # any positive definite values
        model[self.pattern.indptr[:-1]] = 4.0 * count
        whole = full_matrix(self.pattern, model).tocsc()
        order = np.argsort(splu(whole, permc_spec="MMD_AT_PLUS_A", **ON_DIAGONAL).perm_c)
        numbers = full_matrix(self.pattern, np.arange(1.0, count + 1)).tocsc()
        structure = numbers[:, order][order]
        structure.sort_indices()
        return order, structure, structure.data.astype(np.int64) - 1

    def factorise(self, values: Array) -> SuperLUFactor:
        """Return the factor, see `Backend.factorise`."""
        require_finite(values)
        order, structure, source = self._plan
        matrix = csc_array((values[source], structure.indices, structure.indptr), structure.shape)
        try:
            return SuperLUFactor(splu(matrix, permc_spec="NATURAL", **ON_DIAGONAL), order)
        except RuntimeError as error:
            raise SingularMatrix(str(error)) from error

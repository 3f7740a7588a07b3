"""Sparsity pattern of the tangent, built once per body from its cells and free nodes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Pattern:
    """Upper triangle over the free degrees of freedom, in CSR with sorted columns.

    Attributes:
        size: n, the number of free degrees of freedom.
        indptr, indices: CSR structure, (n + 1,) and (nnz,).
        places: Position among the nnz of each entry of the cell matrices, for pairs of nodes
            a <= b, b slowest, and components i, k; nnz for entries that are not stored,
            (E, A (A + 1)/2, D, D).
        number: Number of each degree of freedom among the free ones, -1 if it is fixed, (N, D).
    """

    size: int
    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    places: NDArray[np.int32]
    number: Integers

    @classmethod
    def build(cls, cells: Integers, free: NDArray[np.bool_]) -> "Pattern":
        """Return the pattern of cells (E, A) with a mask of free degrees of freedom (N, D)."""
        nodes = len(free)
        b, a = np.tril_indices(cells.shape[1])
        p, q = cells[:, a], cells[:, b]
        codes, entry = np.unique(np.minimum(p, q) * nodes + np.maximum(p, q), return_inverse=True)
        place, indptr, indices = _places(codes // nodes, codes % nodes, free)
        places = place[entry.reshape(p.shape)]
        transposed = (p > q)[..., None, None]
        places = np.where(transposed, places.swapaxes(-1, -2), places)
        return cls(
            size=int(free.sum()),
            indptr=indptr.astype(np.int32),
            indices=indices.astype(np.int32),
            places=places.astype(np.int32),
            number=_numbered(free),
        )

    def positions(self, row: Integers, column: Integers) -> Integers:
        """Return the positions of entries of pairs of degrees of freedom that belong to one cell.

        The result is nnz for pairs below the diagonal and for fixed ones, whose number is -1.
        """
        owner = np.repeat(np.arange(self.size), np.diff(self.indptr))
        codes = owner * self.size + self.indices
        found = np.searchsorted(codes, row * self.size + column)
        return np.where((row >= 0) & (row <= column), found, len(codes))


def _numbered(free: NDArray[np.bool_]) -> Integers:
    """Return the number of each free degree of freedom, -1 for fixed ones, (N, D)."""
    number = np.full(free.shape, -1)
    number[free] = np.arange(free.sum())
    return number


def _places(
    low: Integers, high: Integers, free: NDArray[np.bool_]
) -> tuple[Integers, Integers, Integers]:
    """Return positions (T, D, D) of the T pairs of nodes low <= high, indptr and indices.

    The pairs are sorted, and contain each node with itself.
    """
    nodes, dim = free.shape
    width = free.sum(axis=1)  # free components of a node
    rank = free.cumsum(axis=1) - free  # number of free components before each one
    number = _numbered(free)
    same = low == high
    before = np.concatenate([[0], np.cumsum(width[high])])
    row_start = before[np.searchsorted(low, np.arange(nodes + 1))]
    lengths = np.diff(row_start)[:, None] - rank  # of the rows of each node
    indptr = np.concatenate([[0], np.cumsum(lengths[free])])
    first = np.zeros(free.shape, dtype=np.int64)
    first[free] = indptr[:-1]
    offset = before[:-1] - row_start[low]  # of each pair in the first row of its node
    place = (first - rank)[low][:, :, None] + offset[:, None, None] + rank[high][:, None, :]
    kept = free[low][:, :, None] & free[high][:, None, :]
    kept &= ~(same[:, None, None] & np.tri(dim, k=-1, dtype=bool))
    indices = np.empty(indptr[-1], dtype=np.int64)
    columns = np.broadcast_to(number[high][:, None, :], place.shape)
    indices[place[kept]] = columns[kept]
    return np.where(kept, place, len(indices)), indptr, indices

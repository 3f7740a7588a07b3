"""Sparsity pattern of the tangent, built once per body from its cells, links and free nodes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array

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
    def build(cls, cells: Integers, links: Integers, free: NDArray[np.bool_]) -> "Pattern":
        """Return the pattern of cells (E, A) and further pairs of nodes (K, 2).

        `free` is the mask of the free degrees of freedom, (N, D).
        """
        nodes, size = len(free), int(free.sum())
        number = np.full(free.shape, -1)
        number[free] = np.arange(size)
        b, a = np.tril_indices(cells.shape[1])
        p, q = (np.append(cells[:, one], links[:, k]) for k, one in enumerate((a, b)))
        codes, entry = np.unique(np.minimum(p, q) * nodes + np.maximum(p, q), return_inverse=True)
        low, high = number[codes // nodes], number[codes % nodes]
        row, column = np.broadcast_arrays(low[:, :, None], high[:, None, :])  # (pairs, D, D)
        stored = (row >= 0) & (row <= column)
        nnz = np.count_nonzero(stored)
        at = row[stored], column[stored]
        matrix = coo_array((np.arange(nnz), at), shape=(size, size)).tocsr()
        matrix.sort_indices()
        order = np.empty(nnz, dtype=np.int32)
        order[matrix.data] = np.arange(nnz)
        place = np.full(stored.shape, nnz, dtype=np.int32)
        place[stored] = order
        places = place[entry]
        transposed = (p > q)[..., None, None]
        places = np.where(transposed, places.swapaxes(-1, -2), places)
        places = places[: cells.shape[0] * len(a)].reshape(len(cells), len(a), *places.shape[1:])
        indptr, indices = (part.astype(np.int32) for part in (matrix.indptr, matrix.indices))
        return cls(size, indptr, indices, places, number)

    def of_entries(self, entries: Integers) -> "tuple[Pattern, Integers]":
        """Return the pattern of some entries, ascending, and the degrees of freedom in it, (m,).

        These degrees of freedom are the free ones of the new pattern.
        """
        rows = np.searchsorted(self.indptr, entries, side="right") - 1
        dofs, found = np.unique([rows, self.indices[entries]], return_inverse=True)
        row, column = found.reshape(2, -1).astype(np.int32)
        indptr = np.searchsorted(row, np.arange(len(dofs) + 1)).astype(np.int32)
        number, place = np.full(self.size + 1, -1), np.full(len(self.indices) + 1, len(entries))
        number[dofs], place[entries] = np.arange(len(dofs)), np.arange(len(entries))
        places = place.astype(np.int32)[self.places]
        return Pattern(len(dofs), indptr, column, places, number[self.number]), dofs

    def positions(self, row: Integers, column: Integers) -> Integers:
        """Return the positions of entries of pairs of degrees of freedom of one cell or link.

        The result is nnz for pairs below the diagonal and for fixed ones, whose number is -1.
        """
        owner = np.repeat(np.arange(self.size), np.diff(self.indptr))
        codes = owner * self.size + self.indices
        found = np.searchsorted(codes, row * self.size + column)
        return np.where((row >= 0) & (row <= column), found, len(codes))

"""Bandwidth-reducing order of unknowns, the same on every machine, and band storage."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, csr_array, csr_matrix
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee

from dpl.fem.linear.interface import Pattern, row_numbers


def reduce_bandwidth(graph: csr_array) -> NDArray[np.int32]:
    """Return the reverse Cuthill-McKee order (n,) of a symmetric graph.

    SciPy starts at a node of lowest degree, which an unstable sort selects differently on other
    processors. Each connected part therefore gets an extra node of degree 1 at its first node of
    lowest degree, where the order then starts; the extra node is removed afterwards.

    Source: George (1971), Computer implementation of the finite element method, Stanford.
    """
    parts, label = connected_components(graph, directed=False)
    degree = np.diff(graph.indptr)
    orders = []
    for part in range(parts):
        nodes = np.flatnonzero(label == part)
        end = csr_array(
            ([1], ([0], [degree[nodes].argmin()])), shape=(1, len(nodes)), dtype=graph.dtype
        )
        longer = block_array([[graph[nodes][:, nodes], end.T], [end, None]], format="csr")
        order = reverse_cuthill_mckee(longer, symmetric_mode=True)
        orders.append(nodes[order[order < len(nodes)]])
    return np.concatenate(orders).astype(np.int32)


class BandStorage(NamedTuple):
    """Places of a pattern's entries in band storage, (n, half + 1), row by row.

    Row j contains column j of the lower triangle from the diagonal down, as LAPACK expects it.
    """

    order: NDArray[np.int32]  # old number of each new unknown, (n,)
    half: int  # half-bandwidth b, the largest distance of an entry from the diagonal
    place: NDArray[np.intp]  # flat index of each entry in the storage, (nnz,)


def band_storage(pattern: Pattern, sweeps: int = 50) -> BandStorage:
    """Return the storage in the pattern's order or in a new one, whichever is narrower.

    The new order is reverse Cuthill-McKee (George 1971), followed by sweeps of node centroids
    (Lim, Rodrigues, Xiao 2006, Eur. J. Oper. Res. 174): each unknown moves to the middle of its
    farthest neighbours, until ten sweeps bring no gain.
    """
    n = pattern.size
    rows, columns = row_numbers(pattern), pattern.indices
    order, half = np.arange(n, dtype=np.int32), int((columns - rows).max(initial=0))
    ones = np.ones(len(rows), dtype=np.int8)
    upper = csr_matrix((ones, columns, pattern.indptr), shape=(n, n))
    graph = upper + upper.T
    trial, idle = reduce_bandwidth(graph), 0
    for sweep in range(sweeps):
        rank = _inverse(trial)
        neighbours = rank[graph.indices]
        last = np.maximum.reduceat(neighbours, graph.indptr[:-1])
        first = np.minimum.reduceat(neighbours, graph.indptr[:-1])
        width = int(max((last - rank).max(), (rank - first).max()))
        idle += 1
        if width < half:
            order, half, idle = trial, width, 0
        if idle > min(sweep, 10):  # none has brought a gain, or the last ten have not
            break
        trial = np.argsort(last + first, kind="stable").astype(np.int32)
    rank = _inverse(order)
    rows, columns = rank[rows], rank[columns]
    column = np.minimum(rows, columns).astype(np.intp)
    return BandStorage(order, half, column * half + np.maximum(rows, columns))


def _inverse(order: NDArray[np.int32]) -> NDArray[np.int32]:
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order), dtype=order.dtype)
    return rank

"""Nested dissection: a tree of parts of a sparse symmetric matrix that separators make independent.

Sources: George (1973), Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10;
Duff, Reid (1983), The multifrontal solution of indefinite sparse symmetric linear equations, ACM
Trans. Math. Softw. 9 (fronts).
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

Integers = NDArray[np.int64]

LEAF = 64  # unknowns of a part that is not divided further
SMALLEST_SIDE = 0.05  # of the unknowns of a part
SAME = 1e-9  # difference of coordinates, over the size of the body, of one layer


class Front(NamedTuple):
    """Unknowns that are eliminated together.

    Attributes:
        pivots: The eliminated unknowns, ascending, (I,).
        boundary: Unknowns that are eliminated later and are coupled to these, directly or by
            earlier eliminations, ascending, (J,).
        children: Numbers of the fronts whose boundaries begin here.
    """

    pivots: Integers
    boundary: Integers
    children: tuple[int, ...]


def nested_dissection(graph: csr_array, points: NDArray[np.float64]) -> list[Front]:
    """Return the fronts of a matrix, children before their parents.

    Args:
        graph: Symmetric matrix with positive entries where unknowns are coupled, (n, n).
        points: Position of each unknown, (n, D).
    """
    fronts: list[Front] = []
    _dissect(graph, points, np.arange(graph.shape[0]), fronts)
    pivots = np.concatenate([front.pivots for front in fronts])
    rank = np.empty_like(pivots)
    rank[pivots] = np.arange(len(pivots))
    for k, front in enumerate(fronts):
        later = [fronts[child].boundary for child in front.children]
        coupled = np.unique(np.concatenate([graph[front.pivots].indices, *later]))
        boundary = coupled[rank[coupled] > rank[front.pivots].max()]
        fronts[k] = front._replace(boundary=boundary.astype(np.int64))
    return fronts


def _dissect(
    graph: csr_array, points: NDArray[np.float64], unknowns: Integers, fronts: list[Front]
) -> tuple[int, ...]:
    """Append the fronts of some unknowns and return the numbers of the last ones, the roots."""
    if not len(unknowns):
        return ()
    own = graph[unknowns][:, unknowns]
    count, part = connected_components(own, directed=False)
    if count > 1:
        pieces = (unknowns[part == k] for k in range(count))
        return tuple(root for one in pieces for root in _dissect(graph, points, one, fronts))
    side = _divide(own, points[unknowns]) if len(unknowns) > LEAF else None
    children: tuple[int, ...] = ()
    if side is not None:
        for k in (-1, 1):
            children += _dissect(graph, points, unknowns[side == k], fronts)
        unknowns = unknowns[side == 0]
    fronts.append(Front(unknowns, unknowns[:0], children))
    return (len(fronts) - 1,)


def _divide(graph: csr_array, points: NDArray[np.float64]) -> NDArray[np.int8] | None:
    """Return the side of each unknown, -1 or 1, and 0 in the smallest separator; None without one.

    Both sides have at least `SMALLEST_SIDE` of the unknowns.
    """
    best = None
    for key in _keys(graph, points):
        middle = np.partition(key, len(key) // 2)[len(key) // 2]
        left = key < middle - SAME
        towards_right = ~left & (graph @ left.astype(float) > 0)
        towards_left = left & (graph @ (~left).astype(float) > 0)
        for separator in (towards_right, towards_left):
            side = np.where(separator, 0, np.where(left, -1, 1)).astype(np.int8)
            least = min((side == -1).sum(), (side == 1).sum())
            if least < SMALLEST_SIDE * len(side):
                continue
            if best is None or separator.sum() < (best == 0).sum():
                best = side
    return best


def _keys(graph: csr_array, points: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Yield values by whose median unknowns are divided: coordinates and layers of neighbours."""
    yield from points.T
    start = dijkstra(graph, unweighted=True, indices=0).argmax()
    yield dijkstra(graph, unweighted=True, indices=int(start))

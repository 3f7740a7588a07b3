"""Solution by nested static condensation: dense blocks instead of triangular factors.

Nested dissection divides a sparse symmetric matrix into a tree of parts that separators make
independent. The unknowns of a part, a front, are condensed as the interior of a substructure is:
with F the matrix of the front after the elimination of its children, I its pivots and J its
boundary,

    forward, children first:  g = F_II^-1 f_I,   f_J <- f_J - X^T f_I,   X = F_II^-1 F_IJ
    backward, parents first:  u_I = g - X u_J

The blocks are stored as they are multiplied, so that a solution consists of products of dense
matrices and vectors. A front without forces below it is left out of the forward pass.

Sources: George (1973), Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10;
Duff, Reid (1983), The multifrontal solution of indefinite sparse symmetric linear equations, ACM
Trans. Math. Softw. 9 (fronts); Guyan (1965), AIAA J. 3 (static condensation).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import float32, float64, int64, njit, void
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem.linear.interface import SingularMatrix

Integers = NDArray[np.int64]

LEAF = 64  # unknowns of a part that is not divided further
SMALLEST_SIDE = 0.05  # of the unknowns of a part
SAME = 1e-9  # difference of coordinates, over the size of the body, of one layer


class Front(NamedTuple):
    """Unknowns that are eliminated together, ascending.

    The boundary are unknowns that are eliminated later and are coupled to the pivots, directly or
    by earlier eliminations.
    """

    pivots: Integers  # the eliminated unknowns, (I,)
    boundary: Integers  # (J,)
    children: tuple[int, ...]  # numbers of the fronts whose boundaries begin here


def nested_dissection(graph: csr_array, points: NDArray[np.float64]) -> list[Front]:
    """Return the fronts of a matrix, children before their parents.

    The graph is a symmetric matrix with positive entries where unknowns are coupled, (n, n). The
    points (n, D) are the positions of the unknowns.
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

    Both sides have at least `SMALLEST_SIDE` of the unknowns. They are divided at the median of a
    coordinate or of the layers of neighbours.
    """
    best = None
    start = int(dijkstra(graph, unweighted=True, indices=0).argmax())
    for key in (*points.T, dijkstra(graph, unweighted=True, indices=start)):
        middle = np.partition(key, len(key) // 2)[len(key) // 2]
        left = key < middle - SAME
        towards_right = ~left & (graph @ left.astype(float) > 0)
        towards_left = left & (graph @ (~left).astype(float) > 0)
        for separator in (towards_right, towards_left):
            side = np.where(separator, 0, np.where(left, -1, 1)).astype(np.int8)
            least = min((side == -1).sum(), (side == 1).sum())
            smaller = best is None or separator.sum() < (best == 0).sum()
            if smaller and least >= SMALLEST_SIDE * len(side):
                best = side
    return best


class Fronts(NamedTuple):
    """Fronts of a matrix, children before their parents, as arrays.

    A row of the table has the first and last position of the pivots among the unknowns, the last
    position of the boundary, and the position of the blocks among the values.
    """

    table: Integers  # (S, 4)
    unknowns: Integers  # pivots and boundary of one front after the other, (T,)
    heights: Integers  # 0 without children, else one more than the largest of theirs, (S,)


class Condensed(NamedTuple):
    """Blocks of P matrices with the same fronts."""

    fronts: Fronts  # the fronts
    values: NDArray[Any]  # F_II^-1 and X of one front after the other, row by row, (P, V)


def condense(matrices: Sequence[csr_array], points: NDArray[np.float64]) -> Condensed:
    """Return the blocks in float64 of P symmetric positive definite matrices, (n, n).

    The matrices have a similar structure. The fronts are chosen by the points, (n, D), the
    positions of the unknowns.

    Raises:
        SingularMatrix: A matrix is not positive definite.
    """
    graph = csr_array(sum(abs(matrix) for matrix in matrices))
    tree = nested_dissection(graph, points)
    updates: dict[int, NDArray[np.float64]] = {}
    table, heights, blocks = [], np.zeros(len(tree), np.int64), []
    first = place = 0
    for k, front in enumerate(tree):
        both, count = np.concatenate([front.pivots, front.boundary]), len(front.pivots)
        F = np.zeros((len(matrices), len(both), len(both)))
        for own, matrix in zip(F, matrices, strict=True):
            own[:count] = matrix[front.pivots][:, both].toarray()
        F[:, count:, :count] = F[:, :count, count:].mT
        position = dict(zip(both.tolist(), range(len(both)), strict=True))
        for child in front.children:
            where = np.array([position[j] for j in tree[child].boundary.tolist()], np.int64)
            F[:, where[:, None], where] += updates.pop(child)
            heights[k] = max(heights[k], heights[child] + 1)
        try:
            roots = np.linalg.inv(np.linalg.cholesky(F[:, :count, :count]))
        except np.linalg.LinAlgError as error:
            raise SingularMatrix("the matrix is not positive definite") from error
        inverse = roots.mT @ roots  # exactly symmetric
        X = inverse @ F[:, :count, count:]
        updates[k] = F[:, count:, count:] - F[:, count:, :count] @ X
        table.append((first, first + count, first + len(both), place))
        first, place = first + len(both), place + count * len(both)
        blocks += [inverse.reshape(len(F), -1), X.reshape(len(F), -1)]
    unknowns = np.concatenate([part for front in tree for part in front[:2]])
    fronts = Fronts(np.array(table), unknowns, heights)
    return Condensed(fronts, np.concatenate(blocks, axis=1))


@njit(fastmath=True)
def add_product(x, A, y):  # type: ignore[no-untyped-def]
    """Add x A to y, (R,), for x (F,) and A (F, R); four rows where x is zero are not read."""
    n = A.shape[1]
    i = 0
    while i + 4 <= len(x):
        a, b, c, d = x[i], x[i + 1], x[i + 2], x[i + 3]
        if a != 0.0 or b != 0.0 or c != 0.0 or d != 0.0:
            for j in range(n):
                y[j] += a * A[i, j] + b * A[i + 1, j] + c * A[i + 2, j] + d * A[i + 3, j]
        i += 4
    while i < len(x):
        for j in range(n):
            y[j] += x[i] * A[i, j]
        i += 1


@njit(fastmath=True)
def subtract_product(A, x, y):  # type: ignore[no-untyped-def]
    """Subtract A x from y, (F,), for A (F, R) and x (R,); x is read once for four rows."""
    n = A.shape[1]
    i = 0
    while i + 4 <= len(y):
        a = b = c = d = x.dtype.type(0)
        for j in range(n):
            a += A[i, j] * x[j]
            b += A[i + 1, j] * x[j]
            c += A[i + 2, j] * x[j]
            d += A[i + 3, j] * x[j]
        y[i] -= a
        y[i + 1] -= b
        y[i + 2] -= c
        y[i + 3] -= d
        i += 4
    while i < len(y):
        a = x.dtype.type(0)
        for j in range(n):
            a += A[i, j] * x[j]
        y[i] -= a
        i += 1


@njit
def condensed_solve(table, unknowns, values, force, solution):  # type: ignore[no-untyped-def]
    """Set `solution` (n,) to that of one matrix, see `condensed_solves`."""
    work, dtype = np.zeros_like(force), force.dtype
    for s in range(len(table)):
        first, middle, last, place = table[s]
        pivots, boundary = unknowns[first:middle], unknowns[middle:last]
        count, others = len(pivots), len(boundary)
        square = count * count
        own, is_loaded = np.empty(count, dtype), False
        for i in range(count):
            own[i] = force[pivots[i]]
            is_loaded = is_loaded or own[i] != 0.0
        inner, passed = np.zeros(count, dtype), work[:others]
        if is_loaded:
            passed[:] = 0.0
            add_product(own, values[place : place + square].reshape((count, count)), inner)
            X = values[place + square : place + square + count * others]
            add_product(own, X.reshape((count, others)), passed)
            for j in range(others):
                force[boundary[j]] -= passed[j]
        for i in range(count):
            solution[pivots[i]] = inner[i]
    for s in range(len(table) - 1, -1, -1):
        first, middle, last, place = table[s]
        pivots, boundary = unknowns[first:middle], unknowns[middle:last]
        count, others = len(pivots), len(boundary)
        start, outer = place + count * count, work[:others]
        for j in range(others):
            outer[j] = solution[boundary[j]]
        own = np.empty(count, dtype)
        for i in range(count):
            own[i] = solution[pivots[i]]
        X = values[start : start + count * others].reshape((count, others))
        subtract_product(X, outer, own)
        for i in range(count):
            solution[pivots[i]] = own[i]


@njit(
    [
        void(int64[:, ::1], int64[::1], float32[:, ::1], float32[:, ::1], float32[:, ::1]),
        void(int64[:, ::1], int64[::1], float32[:, ::1], float64[:, ::1], float64[:, ::1]),
        void(int64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1]),
    ],
    nogil=True,
    cache=True,
)
def condensed_solves(table, unknowns, values, forces, solutions):  # type: ignore[no-untyped-def]
    """Set `solutions` (P, n) to those of P matrices, one force (P, n) each, of the same type.

    The forces are in float64 or in the type of the blocks and are overwritten. For table, unknowns
    and values, (P, V), see `Fronts` and `Condensed`.
    """
    for p in range(len(values)):
        if (forces[p] != 0.0).any():
            condensed_solve(table, unknowns, values[p], forces[p], solutions[p])
        else:
            solutions[p] = 0.0


class Layer(NamedTuple):
    """Fronts of the same height and similar sizes, filled to one size; none depends on another."""

    pivots: Tensor  # pivots of each front, n where there are fewer, (k, I)
    boundary: Tensor  # their boundaries, n where there are fewer, (k, J)
    inverse: Tensor  # F_II^-1 of P matrices, zero in filled rows and columns, (P, k, I, I)
    coupling: Tensor  # X, (P, k, I, J)


def condensed_layers(blocks: Condensed, device: torch.device | str) -> list[Layer]:
    """Return the blocks on a device, in their dtype, fronts without children first."""
    table, _, heights = blocks.fronts
    classes = np.rint(2 * np.log2(table[:, 1] - table[:, 0]))  # similar numbers of pivots
    kinds = sorted(set(zip(heights.tolist(), classes.tolist(), strict=True)))
    chosen = (np.flatnonzero((heights == h) & (classes == c)) for h, c in kinds)
    return [Layer(*(part.to(device) for part in _layer(blocks, fronts))) for fronts in chosen]


def solve_layers(layers: Sequence[Layer], right: Tensor) -> Tensor:
    """Return the solutions (P, B, n) of right-hand sides (P, B, n) of the dtype of the blocks.

    Each layer is a product of batches of matrices, for batches, gradients, GPUs and graphs. The
    n-th unknown, where fronts are filled, is always zero.
    """
    force, inner = pad(right, (0, 1)), []
    for layer in layers:
        own = force[..., layer.pivots].transpose(1, 2)  # (P, k, B, I)
        inner.append(own @ layer.inverse)
        passed = (own @ layer.coupling).transpose(1, 2).flatten(2)
        force = force.index_add(2, layer.boundary.flatten(), -passed)
    solution = torch.zeros_like(force)
    for layer, own in zip(reversed(layers), reversed(inner), strict=True):
        outer = solution[..., layer.boundary].transpose(1, 2)
        found = (own - outer @ layer.coupling.transpose(2, 3)).transpose(1, 2).flatten(2)
        solution = solution.index_add(2, layer.pivots.flatten(), found)
    return solution[..., :-1]


def _layer(blocks: Condensed, numbers: Integers) -> Layer:
    """Return some fronts, by their numbers."""
    (table, unknowns, _), values = blocks
    size, ends = len(np.unique(unknowns)), table[numbers]
    count = int((ends[:, 1] - ends[:, 0]).max())
    others = max(1, int((ends[:, 2] - ends[:, 1]).max()))  # graphs have no empty tensors
    shape = len(numbers), count, others
    pivots, boundary = np.full(shape[:2], size), np.full((len(numbers), others), size)
    inverse = np.zeros((len(values), len(numbers), count, count), values.dtype)
    coupling = np.zeros((len(values), *shape), values.dtype)
    for k, (first, middle, last, place) in enumerate(ends.tolist()):
        own, other = middle - first, last - middle
        pivots[k, :own], boundary[k, :other] = unknowns[first:middle], unknowns[middle:last]
        square, rest = np.split(values[:, place : place + own * (own + other)], [own * own], axis=1)
        inverse[:, k, :own, :own] = square.reshape(len(values), own, own)
        coupling[:, k, :own, :other] = rest.reshape(len(values), own, other)
    return Layer(*map(torch.from_numpy, (pivots, boundary, inverse, coupling)))

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

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import float32, float64, int64, njit, void
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor

from dpl.fem.linear.interface import SingularMatrix

Integers = NDArray[np.int64]

LEAF = 64  # unknowns of a part that is not divided further
SMALLEST_SIDE = 0.05  # of the unknowns of a part
SAME = 1e-9  # difference of coordinates, over the size of the body, of one layer


def _dissect(
    graph: csr_array,
    points: NDArray[np.float64],
    unknowns: Integers,
    fronts: list[tuple[Integers, tuple[int, ...]]],
    leaf: int,
) -> tuple[int, ...]:
    """Append pivots and children of the fronts of some unknowns; return the numbers of the roots.

    Pivots are ascending. The boundaries of the children begin in their front.
    """
    if not len(unknowns):
        return ()
    own = graph[unknowns][:, unknowns]
    count, part = connected_components(own, directed=False)
    if count > 1:
        pieces = (unknowns[part == k] for k in range(count))
        return tuple(root for one in pieces for root in _dissect(graph, points, one, fronts, leaf))
    side = _divide(own, points[unknowns]) if len(unknowns) > leaf else None
    children: tuple[int, ...] = ()
    if side is not None:
        for k in (-1, 1):
            children += _dissect(graph, points, unknowns[side == k], fronts, leaf)
        unknowns = unknowns[side == 0]
    fronts.append((unknowns, children))
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


class Condensed(NamedTuple):
    """Blocks of P matrices with the same fronts, children before their parents.

    A row of the table has the first and last position of the pivots among the unknowns, the last
    position of the boundary, and the position of the blocks among the values.
    """

    table: Integers  # (S, 4)
    unknowns: Integers  # pivots and boundary of one front after the other, (T,)
    heights: Integers  # 0 without children, else one more than the largest of theirs, (S,)
    values: NDArray[Any]  # F_II^-1 and X of one front after the other, row by row, (P, V)


def condense(matrices: Sequence[csr_array], points: NDArray[np.float64]) -> Condensed:
    """Return the blocks in float64 of P symmetric matrices, (n, n), of a similar structure.

    The fronts are chosen by the points, (n, D), the positions of the unknowns; unknowns of a node
    stay together. A matrix that is not positive definite raises a `SingularMatrix`.
    """
    run = next(r for r in (3, 2, 1) if np.array_equal(points, np.repeat(points[::r], r, axis=0)))
    entries = coo_array(sum(abs(matrix) for matrix in matrices))
    graph = csr_array((entries.data, (entries.row // run, entries.col // run)))  # of nodes
    tree: list[tuple[Integers, tuple[int, ...]]] = []
    _dissect(graph, points[::run], np.arange(graph.shape[0]), tree, LEAF // run)
    rank, position = np.empty(graph.shape[0], np.int64), np.empty(len(points), np.int64)
    rank[np.concatenate([pivots for pivots, _ in tree])] = np.arange(len(rank))
    updates: dict[int, tuple[Integers, NDArray[np.float64]]] = {}  # boundaries and F there

    def of_nodes(nodes: Integers) -> Integers:
        return (run * nodes[:, None] + np.arange(run)).ravel()

    table, heights, unknowns, blocks = [], np.zeros(len(tree), np.int64), [], []
    first = place = 0
    for k, (pivots, children) in enumerate(tree):
        passed = [updates.pop(child) for child in children]
        coupled = np.concatenate([graph[pivots].indices, *(boundary for boundary, _ in passed)])
        coupled = np.unique(coupled).astype(np.int64)
        boundary = coupled[rank[coupled] > rank[pivots].max()]
        both, count = of_nodes(np.concatenate([pivots, boundary])), run * len(pivots)
        F = np.zeros((len(matrices), len(both), len(both)))
        for own, matrix in zip(F, matrices, strict=True):
            own[:count] = matrix[both[:count]][:, both].toarray()
        F[:, count:, :count] = F[:, :count, count:].mT
        position[both] = np.arange(len(both))
        for inner, update in passed:
            where = position[of_nodes(inner)]
            F[:, where[:, None], where] += update
        heights[k] = max((heights[child] + 1 for child in children), default=0)
        try:
            roots = np.linalg.inv(np.linalg.cholesky(F[:, :count, :count]))
        except np.linalg.LinAlgError as error:
            raise SingularMatrix("the matrix is not positive definite") from error
        inverse = roots.mT @ roots  # exactly symmetric
        X = inverse @ F[:, :count, count:]
        updates[k] = boundary, F[:, count:, count:] - F[:, count:, :count] @ X
        table.append((first, first + count, first + len(both), place))
        first, place = first + len(both), place + count * len(both)
        unknowns.append(both)
        blocks += [inverse.reshape(len(F), -1), X.reshape(len(F), -1)]
    arrays = np.array(table), np.concatenate(unknowns), heights
    return Condensed(*arrays, np.concatenate(blocks, axis=1))


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
def take(x, places):  # type: ignore[no-untyped-def]
    """Return x[places], which numba computes more slowly with checks of the places."""
    found = np.empty(len(places), x.dtype)
    for i in range(len(places)):
        found[i] = x[places[i]]
    return found


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

    The forces are in float64 or in the type of the blocks and are overwritten. See `Condensed` for
    table, unknowns and values, (P, V).
    """
    for p in range(len(values)):
        force, solution = forces[p], solutions[p]
        if not force.any():
            solution[:] = 0.0
            continue
        for s in range(len(table)):
            first, middle, last, place = table[s]
            pivots, boundary = unknowns[first:middle], unknowns[middle:last]
            own, count = take(force, pivots), len(pivots)
            inner, start = np.zeros_like(own), place + count * count
            if own.any():
                add_product(own, values[p, place:start].reshape((count, count)), inner)
                passed = np.zeros(len(boundary), own.dtype)
                X = values[p, start : start + count * len(boundary)]
                add_product(own, X.reshape((count, len(boundary))), passed)
                for j in range(len(boundary)):
                    force[boundary[j]] -= passed[j]
            for i in range(count):
                solution[pivots[i]] = inner[i]
        for s in range(len(table) - 1, -1, -1):
            first, middle, last, place = table[s]
            pivots, boundary = unknowns[first:middle], unknowns[middle:last]
            own, count = take(solution, pivots), len(pivots)
            X = values[p, place + count * count : place + count * (count + len(boundary))]
            subtract_product(X.reshape((count, len(boundary))), take(solution, boundary), own)
            for i in range(count):
                solution[pivots[i]] = own[i]


def add_inverses(
    blocks: Condensed, unknowns: Integers, signs: NDArray[np.float64], out: NDArray[np.float64]
) -> Iterator[None]:
    """Add S A^-1 S at k unknowns of each matrix A to `out` (k, k), in a step for each front.

    S is the diagonal of `signs`, (P, k). With A = L D L^T the inverse is (L^-1)^T D^-1 L^-1, so
    that only the forward pass is made, for all columns at once and in the dtype of the blocks.
    """
    size = len(np.unique(blocks.unknowns))
    for values, own in zip(blocks.values, signs, strict=True):
        forces = np.zeros((size, len(unknowns)), values.dtype)
        forces[unknowns, np.arange(len(unknowns))] = own
        for first, middle, last, place in blocks.table.tolist():
            pivots, boundary = blocks.unknowns[first:middle], blocks.unknowns[middle:last]
            acting = np.flatnonzero(forces[pivots].any(axis=0))
            if not len(acting):
                continue
            count, right = len(pivots), forces[pivots[:, None], acting]
            inverse, X = np.split(values[place : place + count * (last - first)], [count * count])
            out[acting[:, None], acting] += right.T @ (inverse.reshape(count, count) @ right)
            forces[boundary[:, None], acting] -= X.reshape(count, len(boundary)).T @ right
            yield


class Layer(NamedTuple):
    """Fronts of the same height and similar sizes, filled to one size; none depends on another."""

    received: Tensor  # positions of F_JI F_II^-1 f of layers before, (w, k I / c)
    boundary: Tensor  # positions among solutions of layers behind, the last first, (k J / c,)
    inverse: Tensor  # F_II^-1 of P matrices, zero in filled rows and columns, (P, k, I, I)
    coupling: Tensor  # X, (P, k, I, J)


class Layers(NamedTuple):
    """Blocks as layers, those without children first; positions are those of c unknowns each."""

    layers: list[Layer]
    pivots: Tensor  # of one layer after the other, n / c where there are fewer
    places: Tensor  # of each solution, (n / c,)


def condensed_layers(blocks: Condensed, device: torch.device | str) -> Layers:
    """Return the blocks on a device, in their dtype."""
    table, unknowns, heights, values = blocks
    run = run_length(unknowns, table[:, 1], table[:, 2])
    size, widths = len(np.unique(unknowns)), np.diff(table[:, :3])  # numbers of pivots, boundary
    kinds = np.stack([heights, np.rint(np.log2(widths[:, 0])).astype(int)], axis=1)
    layers = []
    for kind in np.unique(kinds, axis=0):  # one height, similar numbers of pivots
        chosen = np.flatnonzero((kinds == kind).all(axis=1))
        count, others = widths[chosen].max(axis=0)
        pivots, boundary = (np.full((len(chosen), width), size) for width in (count, others))
        inverse = np.zeros((len(values), len(chosen), count, count), values.dtype)
        coupling = np.zeros((len(values), len(chosen), count, others), values.dtype)
        for k, (first, middle, last, place) in enumerate(table[chosen].tolist()):
            own, other = middle - first, last - middle
            pivots[k, :own], boundary[k, :other] = unknowns[first:middle], unknowns[middle:last]
            block = values[:, place : place + own * (own + other)]
            square, rest = np.split(block, [own * own], axis=1)
            inverse[:, k, :own, :own] = square.reshape(len(values), own, own)
            coupling[:, k, :own, :other] = rest.reshape(len(values), own, other)
        runs = (part.ravel()[::run] // run for part in (pivots, boundary))
        layers.append((*runs, inverse, coupling))
    none, size = np.array([size // run]), size // run
    received = _positions(np.concatenate([none, *(layer[1] for layer in layers)]), size)
    behind = np.concatenate([none, *(layer[0] for layer in layers[::-1])])
    solved = np.zeros(size + 1, np.int64)
    solved[behind[::-1]] = np.arange(len(behind))[::-1]  # the n-th unknown is the first one, zero
    found = []
    for pivots, boundary, *matrices in layers:
        rows = received[pivots]
        rows = rows[:, : int((rows > 0).sum(axis=1).max())].T.copy()
        arrays = rows, solved[boundary], *matrices
        found.append(Layer(*(torch.from_numpy(array).to(device) for array in arrays)))
    ends = np.concatenate([layer[0] for layer in layers]), solved[:-1]
    return Layers(found, *(torch.from_numpy(array).to(device) for array in ends))


def run_length(positions: Integers, *ends: Integers) -> int:
    """Return the largest length up to 3 of runs of which positions consist, each from a multiple.

    The ends of parts of them are ends of runs. Rows of whole runs are selected faster.
    """
    for run in (3, 2):
        if all((end % run == 0).all() for end in (np.array([len(positions)]), *ends)):
            own = positions.reshape(-1, run)
            if (own == run * (own[:, :1] // run) + np.arange(run)).all():
                return run
    return 1


def _positions(names: Integers, count: int) -> Integers:
    """Return the positions of each name below `count`, filled with 0, (count + 1, w)."""
    order = np.argsort(names, kind="stable")[: int((names < count).sum())]
    which = names[order]
    number = np.arange(len(which)) - np.searchsorted(which, which)  # among those of the same name
    rows = np.zeros((count + 1, int(number.max(initial=0)) + 1), np.int64)
    rows[which, number] = order
    return rows


def solve_layers(blocks: Layers, right: Tensor) -> Tensor:
    """Return the solutions (n, P, B) of right-hand sides (n, P, B) of the dtype of the blocks.

    Each layer is a product of batches of matrices, for batches, gradients, GPUs and graphs. The
    unknowns are the first axis, whose rows onnxruntime copies whole, and the batch is the last one,
    so that one load is a column.
    """
    right = right.unflatten(0, (len(blocks.places), -1))  # (n / c, c, P, B)
    zero = torch.zeros_like(right[:1])
    forces = torch.cat([right, zero]).index_select(0, blocks.pivots).flatten(0, 1)
    sizes = [layer.inverse[0, :, 0].numel() for layer in blocks.layers]
    passed, solved, inner = zero, zero, []
    for layer, own in zip(blocks.layers, forces.split(sizes), strict=True):
        if len(layer.received):
            terms = passed.index_select(0, layer.received.flatten())
            own = own - terms.unflatten(0, layer.received.shape).sum(0).flatten(0, 1)
        own = own.unflatten(0, layer.inverse.shape[1:3])  # (k, I, P, B)
        inner.append(layer.inverse @ own.permute(2, 0, 1, 3))
        if len(layer.boundary):
            terms = own.permute(2, 0, 3, 1) @ layer.coupling  # (P, k, B, J)
            terms = terms.permute(1, 3, 0, 2).reshape(-1, *zero.shape[1:])
            passed = torch.cat([passed, terms])
    for layer, own in zip(reversed(blocks.layers), reversed(inner), strict=True):
        if len(layer.boundary):
            outer = solved.index_select(0, layer.boundary).flatten(0, 1)
            shape = layer.coupling.shape[1], layer.coupling.shape[3]
            own = own - layer.coupling @ outer.unflatten(0, shape).permute(2, 0, 1, 3)
        found = own.permute(1, 2, 0, 3).reshape(-1, *zero.shape[1:])
        solved = torch.cat([solved, found])
    return solved.index_select(0, blocks.places).flatten(0, 1)

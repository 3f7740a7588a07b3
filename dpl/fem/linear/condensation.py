"""Solution by nested static condensation: dense blocks instead of triangular factors.

Nested dissection divides a sparse symmetric matrix into a tree of parts that separators make
independent. The unknowns of a part, a front, are condensed as the interior of a substructure is:
with F the matrix of the front after the elimination of its children, I its pivots and J its
boundary,

    forward, children first:  g = F_II^-1 f_I,   f_J <- f_J - X^T f_I,   X = F_II^-1 F_IJ
    backward, parents first:  u_I = g - X u_J

The blocks are stored as they are multiplied, so that a solution consists of products of dense
matrices and vectors (`condensed_solves`). `rounded` blocks have 16 bits for each entry: a solution
reads the blocks once or twice and takes as long as that.

Sources: George (1973), Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10;
Duff, Reid (1983), The multifrontal solution of indefinite sparse symmetric linear equations, ACM
Trans. Math. Softw. 9 (fronts); Guyan (1965), AIAA J. 3 (static condensation).
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor

from dpl.fem.linear.condensed_loops import condensed_solves, round_rows
from dpl.fem.linear.interface import SingularMatrix
from dpl.fem.linear.tiles import high, tiled, untiled, wide

Integers = NDArray[np.int64]

LEAF = 64  # unknowns of a part that is not divided further
SMALLEST_SIDE = 0.05  # of the unknowns of a part
SAME = 1e-9  # difference of coordinates, over the size of the body, of one layer
TESTS = 8  # vectors whose products `rounded` blocks preserve
SWEEPS = 3  # of the scaling of rows and columns before their entries are rounded
LARGEST = 2**15 - 2  # entry in units of its row and column; rounding up adds one


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
    position of the boundary, and the position of the blocks among the values. Unknowns are numbered
    as they are eliminated, so that pivots follow each other. Blocks are filled with zeros to whole
    tiles, see `tiled`. The entries are values times factors of their row and column.
    """

    table: Integers  # (S, 4)
    order: NDArray[np.uint32]  # equation of each unknown, (n,)
    unknowns: NDArray[np.uint32]  # pivots and boundary of one front after the other, (T,)
    heights: Integers  # 0 without children, else one more than the largest of theirs, (S,)
    values: NDArray[Any]  # F_II^-T and X of one front after the other, tiled, (P, V)
    factors: NDArray[Any]  # of rows of F_II^-T, rows of X, and columns, by unknowns, (P, 3, T)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of forces and solutions: float32 for rounded values, else float64."""
        return self.factors.dtype

    def front(self, p: int, k: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return F_II^-1 (I, I) and X (I, J) of a front of a matrix in `dtype`."""
        first, middle, last, place = self.table[k].tolist()
        of_inverse, of_coupling, columns = self.factors[p, :, first:last]
        count, found = middle - first, []
        for rows, own in ((of_inverse, columns[:count]), (of_coupling, columns[count:])):
            end = place + high(count) * wide(len(own))
            block = untiled(self.values[p, place:end], count, len(own))
            found.append(rows[:count, None] * block * own)
            place = end
        return found[0].T, found[1]


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
        unknowns.append(both)
        for block in (inverse, X):
            blocks.append(tiled(block))
            place += blocks[-1].shape[1]
        first += len(both)
    factors = np.ones((len(matrices), 3, first))
    order = of_nodes(np.argsort(rank))
    found = np.argsort(order)[np.concatenate(unknowns)].astype(np.uint32)
    arrays = np.array(table), order.astype(np.uint32), found, heights
    return Condensed(*arrays, np.concatenate(blocks, axis=1), factors)


def rounded(blocks: Condensed, forces: NDArray[np.float64] | None = None) -> Condensed:
    """Return blocks of 16-bit integers with factors in float32.

    Each entry is rounded up or down such that the products of its row with the vectors of some
    solutions stay the same, those of `TESTS` random forces and of given ones, (K, P, n). Solutions
    of smooth forces then change by 1e-6, of others by 1e-5; with the nearest numbers both change by
    1e-5 to 3e-5.

    Source: Frantar, Ashkboos, Hoefler, Alistarh (2023), GPTQ, ICLR (rounding that makes up for the
    errors of the entries before).
    """
    values = np.zeros(blocks.values.shape, np.int16)
    factors, size = np.ones(blocks.factors.shape, np.float32), len(blocks.order)
    for p in range(len(values)):
        right = np.random.default_rng(1).standard_normal((size, TESTS))[blocks.order]
        if forces is not None:
            right = np.concatenate([right, forces[:, p, blocks.order].T], axis=1)
        solutions, acting = np.zeros_like(right), []
        for k, (first, middle, last, _) in enumerate(blocks.table.tolist()):
            pivots, boundary = blocks.unknowns[first:middle], blocks.unknowns[middle:last]
            inverse, X = blocks.front(p, k)
            acting.append(right[pivots])
            solutions[pivots] = inverse @ right[pivots]
            right[boundary] -= X.T @ right[pivots]
        for k, (first, middle, last, place) in reversed(list(enumerate(blocks.table.tolist()))):
            pivots, boundary = blocks.unknowns[first:middle], blocks.unknowns[middle:last]
            inverse, X = blocks.front(p, k)
            solutions[pivots] -= X @ solutions[boundary]
            tests, count = (acting[k], solutions[boundary]), middle - first
            for n, (block, own) in enumerate(zip((inverse, X), tests, strict=True)):
                rows, columns = _scales(block)
                scaled, own = block / (rows[:, None] * columns), columns[:, None] * own
                own /= np.maximum(np.linalg.norm(own, axis=0), np.finfo(float).tiny)
                found = np.empty(block.shape, np.int16)
                round_rows(scaled, own, np.argsort(-np.linalg.norm(own, axis=1)), found)
                if n == 0:
                    found, rows, columns = found.T, columns, rows
                factors[p, n, first:middle] = rows
                factors[p, 2, slice(middle, last) if n else slice(first, middle)] = columns
                end = place + high(count) * wide(len(columns))
                values[p, place:end] = tiled(found)
                place = end
    return blocks._replace(values=values, factors=factors)


def _scales(block: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return factors of rows and columns over which entries are at most `LARGEST`, and similar.

    Source: Ruiz (2001), A scaling algorithm to equilibrate both rows and columns norms in matrices.
    """
    size = np.abs(block)
    rows, columns = np.ones(len(block)), np.ones(block.shape[1])
    for _ in range(SWEEPS):
        for axis, factors in ((1, rows), (0, columns)):
            most = np.sqrt((size / (rows[:, None] * columns)).max(axis=axis, initial=0.0))
            factors *= np.where(most > 0, most, 1.0)
    most = (size / (rows[:, None] * columns)).max(axis=1, initial=0.0)
    rows = np.where(most > 0, rows * most, 1.0) / LARGEST
    return rows.astype(np.float32).astype(float), columns.astype(np.float32).astype(float)


def condensed_solutions(blocks: Condensed, forces: NDArray[Any]) -> NDArray[Any]:
    """Return the solutions of one force for each of P matrices, (P, n) each, in their dtype."""
    solutions = np.empty(forces.shape, blocks.dtype)
    table, order, unknowns, _, values, factors = blocks
    forces = np.ascontiguousarray(forces, blocks.dtype)
    condensed_solves(table, order, unknowns, values, factors, forces, solutions)
    return solutions


def add_inverses(
    blocks: Condensed, unknowns: Integers, signs: NDArray[np.float64],
    weights: NDArray[np.float64], out: NDArray[np.float64],
) -> Iterator[None]:  # fmt: skip
    """Add w S A^-1 S at k unknowns of each matrix A to `out` (k, k), in a step for each front.

    S is the diagonal of `signs`, (P, k), and w a weight of each matrix, (P,). With A = L D L^T the
    inverse is (L^-1)^T D^-1 L^-1, so that only the forward pass is made, for all columns at once
    and in the dtype of the blocks.
    """
    places = np.argsort(blocks.order)[unknowns]
    for p, (own, weight) in enumerate(zip(signs, weights, strict=True)):
        forces = np.zeros((len(blocks.order), len(places)), blocks.dtype)
        forces[places, np.arange(len(places))] = own
        for k, (first, middle, last, _) in enumerate(blocks.table.tolist()):
            pivots, boundary = blocks.unknowns[first:middle], blocks.unknowns[middle:last]
            acting = np.flatnonzero(forces[pivots].any(axis=0))
            if not len(acting):
                continue
            right, (inverse, X) = forces[pivots[:, None], acting], blocks.front(p, k)
            out[acting[:, None], acting] += weight * (right.T @ (inverse @ right))
            forces[boundary[:, None], acting] -= X.T @ right
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
    table, order, numbers, heights, values, _ = blocks
    unknowns = order[numbers].astype(np.int64)
    run = run_length(unknowns, table[:, 1], table[:, 2])
    size, widths = len(order), np.diff(table[:, :3])  # numbers of pivots, boundary
    kinds = np.stack([heights, np.rint(np.log2(widths[:, 0])).astype(int)], axis=1)
    layers = []
    for kind in np.unique(kinds, axis=0):  # one height, similar numbers of pivots
        chosen = np.flatnonzero((kinds == kind).all(axis=1))
        count, others = widths[chosen].max(axis=0)
        pivots, boundary = (np.full((len(chosen), width), size) for width in (count, others))
        inverse = np.zeros((len(values), len(chosen), count, count), blocks.dtype)
        coupling = np.zeros((len(values), len(chosen), count, others), blocks.dtype)
        for k, (first, middle, last, _) in enumerate(table[chosen].tolist()):
            own, other = middle - first, last - middle
            pivots[k, :own], boundary[k, :other] = unknowns[first:middle], unknowns[middle:last]
            for p in range(len(values)):
                inverse[p, k, :own, :own], coupling[p, k, :own, :other] = blocks.front(p, chosen[k])
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
    """Return the solutions (P, n, B) of right-hand sides (P, n, B) of the dtype of the blocks.

    Each layer is a product of batches of matrices, for batches, gradients, GPUs and graphs. The
    batch is the last axis, so that one load is a column, and the unknowns are the axis before, so
    that blocks of matrices need no transpositions.
    """
    right = right.unflatten(1, (len(blocks.places), -1))  # (P, n / c, c, B)
    zero = torch.zeros_like(right[:, :1])
    forces = torch.cat([right, zero], dim=1).index_select(1, blocks.pivots)
    sizes = [layer.inverse[0, :, 0].numel() // right.shape[2] for layer in blocks.layers]
    passed, solved, acting = zero, zero, []
    for layer, own in zip(blocks.layers, forces.split(sizes, dim=1), strict=True):
        if len(layer.received):
            terms = passed.index_select(1, layer.received.flatten())
            own = own - terms.unflatten(1, layer.received.shape).sum(1)
        own = own.flatten(1, 2).unflatten(1, layer.inverse.shape[1:3])  # (P, k, I, B)
        acting.append(own)
        if len(layer.boundary):
            # the attribute mT would be a second input of a loop in a graph, which may not be a view
            terms = (layer.coupling.transpose(2, 3) @ own).flatten(1, 2)  # (P, k J, B)
            passed = torch.cat([passed, terms.unflatten(1, (-1, right.shape[2]))], dim=1)
    for layer, own in zip(reversed(blocks.layers), reversed(acting), strict=True):
        own = layer.inverse @ own
        if len(layer.boundary):
            outer = solved.index_select(1, layer.boundary).flatten(1, 2)
            own = own - layer.coupling @ outer.unflatten(1, layer.coupling.shape[1::2])
        found = own.flatten(1, 2).unflatten(1, (-1, right.shape[2]))
        solved = torch.cat([solved, found], dim=1)
    return solved.index_select(1, blocks.places).flatten(1, 2)

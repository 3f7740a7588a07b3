"""The mesh as a graph, and coarser and coarser clusters of its nodes."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpl.fem import Problem

COARSEST = 24  # clusters of the last level, which all hear each other

Integers = NDArray[np.int64]
Floats = NDArray[np.float64]


class Graph(NamedTuple):
    """Nodes, or clusters of them, and who hears whom.

    Attributes:
        points: Places, (K, D) [-].
        receiver: Who hears, (P,), ascending.
        sender: Whom, (P,); with (i, j) there is (j, i).
        whole: Whether all hear all, themselves too.
    """

    points: Floats
    receiver: Integers
    sender: Integers
    whole: bool

    @property
    def spacing(self) -> float:
        """Mean distance of those that hear each other [-]."""
        way = np.linalg.norm(self.points[self.sender] - self.points[self.receiver], axis=1)
        return float(way[way > 0].mean()) if way.any() else 1.0

    def features(self) -> Floats:
        """Return ways from receiver to sender and their lengths over the spacing, (P, D + 1)."""
        way = (self.points[self.sender] - self.points[self.receiver]) / self.spacing
        return np.column_stack([way, np.linalg.norm(way, axis=1)])


def mesh_graph(problem: Problem) -> Graph:
    """Return the graph of a mesh: nodes of a cell that are closest together hear each other.

    Closest in the regular cell (square, cube, equilateral triangle, regular tetrahedron), whatever
    the cell's shape: along the cell's edges, in halves where it is quadratic. In a mesh of at most
    `COARSEST` nodes all hear all.
    """
    points = problem.points.numpy()
    if len(points) <= COARSEST:
        return _whole(points)
    element = problem.basis.elem
    places = np.asarray(element.doflocs)  # (A, D)
    if element.refdom.name in ("Triangular", "Tetrahedral"):
        places = places @ np.linalg.cholesky((np.eye(places.shape[1]) + 1) / 2)
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    apart[np.diag_indices_from(apart)] = np.inf
    one, other = np.nonzero(apart < apart.min() * 1.01)
    cells = problem.cells.numpy()
    return _joined(points, cells[:, one].ravel(), cells[:, other].ravel())


def coarser(graph: Graph, count: int) -> tuple[Graph, Integers]:
    """Return the graph of so many clusters of nodes, and the cluster of each node, (K,).

    Centres are chosen one by one, each farthest from those before; nodes belong to the nearest.
    Distances are numbers of edges and ties go to the first, so that rounding, of a body moved far
    away, say, does not change clusters. Each separate part of a body has a cluster at least, even
    where that makes more than `count`. Clusters hear each other where members do, and all of them
    where they are `COARSEST` or fewer.

    Source: Gonzalez (1985), Clustering to minimize the maximum intercluster distance.
    """
    nodes = len(graph.points)
    start = np.searchsorted(graph.receiver, np.arange(nodes + 1)).tolist()
    sender = graph.sender.tolist()
    distance = np.full(nodes, nodes, dtype=np.int64)
    cluster = np.zeros(nodes, dtype=np.int64)
    chosen = 0
    while chosen < min(count, nodes) or distance.max() == nodes:
        ring, reach = [int(distance.argmax())], 0
        while ring:
            distance[ring], cluster[ring] = reach, chosen
            reach += 1
            heard = {k for i in ring for k in sender[start[i] : start[i + 1]]}
            ring = sorted(k for k in heard if distance[k] > reach)
        chosen += 1
    members = np.bincount(cluster)
    points = np.column_stack([np.bincount(cluster, axis) / members for axis in graph.points.T])
    if chosen <= COARSEST:
        return _whole(points), cluster
    return _joined(points, cluster[graph.receiver], cluster[graph.sender]), cluster


def hierarchy(problem: Problem, levels: int | None = None) -> tuple[list[Graph], list[Integers]]:
    """Return the graphs of all levels, nodes first, and the clusters that lead to each next one.

    Sizes fall by one factor from level to level, down to `COARSEST`. Without `levels` there are as
    many as keep that factor at 2^D or less, where clusters become twice as wide.
    """
    nodes, dim = problem.shape
    needed = math.ceil(max(0.0, math.log(nodes / COARSEST, 2**dim)))
    steps = min(needed if levels is None else levels - 1, nodes - 1 if needed else 0)
    graphs, clusters = [mesh_graph(problem)], []
    for step in range(1, steps + 1):
        count = round(nodes * (COARSEST / nodes) ** (step / steps))
        graph, cluster = coarser(graphs[-1], count)
        graphs.append(graph)
        clusters.append(cluster)
    return graphs, clusters


def means(values: Floats, cluster: Integers) -> Floats:
    """Return the means of values (K, ...) over the members of each cluster."""
    members = np.bincount(cluster)
    return np.column_stack([np.bincount(cluster, column) / members for column in values.T])


def _whole(points: Floats) -> Graph:
    return Graph(points, *np.divmod(np.arange(len(points) ** 2), len(points)), whole=True)


def _joined(points: Floats, receiver: Integers, sender: Integers) -> Graph:
    apart = receiver != sender
    pairs = np.unique(receiver[apart] * len(points) + sender[apart])
    return Graph(points, *np.divmod(pairs, len(points)), whole=False)

"""The mesh as a graph, and a hierarchy of clusters of its nodes."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpl.fem import Problem

COARSEST = 24  # clusters of the last level, which form a complete graph

Integers = NDArray[np.int64]
Floats = NDArray[np.float64]


class Graph(NamedTuple):
    """Symmetric directed graph of nodes or clusters."""

    points: Floats  # positions, (K, D) [-]
    receiver: Integers  # of each edge, (P,), ascending
    sender: Integers  # of each edge, (P,)
    complete: bool  # all pairs are edges, with loops

    @property
    def spacing(self) -> float:
        """Mean length of edges other than loops [-]."""
        length = np.linalg.norm(self.points[self.sender] - self.points[self.receiver], axis=1)
        return float(length[length > 0].mean()) if length.any() else 1.0

    def features(self) -> Floats:
        """Return vectors from receiver to sender and their lengths over the spacing, (P, D + 1)."""
        vector = (self.points[self.sender] - self.points[self.receiver]) / self.spacing
        return np.column_stack([vector, np.linalg.norm(vector, axis=1)])


def mesh_graph(problem: Problem) -> Graph:
    """Return the graph of a mesh: edges connect the closest nodes of a cell.

    Distances are those in the regular cell (square, cube, equilateral triangle, regular
    tetrahedron), so that edges of the graph are edges of the cell, or halves of them in quadratic
    cells. The graph of a mesh of at most `COARSEST` nodes is complete.
    """
    points = problem.points.numpy()
    if len(points) <= COARSEST:
        return _complete(points)
    element = problem.basis.elem
    places = np.asarray(element.doflocs)  # (A, D)
    if element.refdom.name in ("Triangular", "Tetrahedral"):
        places = places @ np.linalg.cholesky((np.eye(places.shape[1]) + 1) / 2)
    distance = np.linalg.norm(places[:, None] - places, axis=-1)
    distance[np.diag_indices_from(distance)] = np.inf
    one, other = np.nonzero(distance < distance.min() * 1.01)
    cells = problem.cells.numpy()
    return _graph(points, cells[:, one].ravel(), cells[:, other].ravel())


def coarser(graph: Graph, count: int) -> tuple[Graph, Integers]:
    """Return the graph of `count` clusters of nodes, and the cluster of each node, (K,).

    Centres are chosen one by one, each farthest from the previous ones; a node belongs to the
    nearest centre. Distances are numbers of edges and ties go to the first centre, so that clusters
    do not depend on rounding errors of coordinates. Each connected component has at least one
    cluster, even if there are then more than `count`. Clusters are connected if members are; a
    graph of at most `COARSEST` clusters is complete.

    Source: Gonzalez (1985), Clustering to minimize the maximum intercluster distance.
    """
    nodes, sender, centres = len(graph.points), graph.sender.tolist(), 0
    start = np.searchsorted(graph.receiver, np.arange(nodes + 1)).tolist()
    distance, cluster = np.full(nodes, nodes), np.zeros(nodes, np.int64)
    while centres < min(count, nodes) or distance.max() == nodes:
        front, steps = [int(distance.argmax())], 0
        while front:
            distance[front] = steps
            cluster[front] = centres
            steps += 1
            neighbours = {k for i in front for k in sender[start[i] : start[i + 1]]}
            front = sorted(k for k in neighbours if distance[k] > steps)
        centres += 1
    points = means(graph.points, cluster)
    if centres <= COARSEST:
        return _complete(points), cluster
    return _graph(points, cluster[graph.receiver], cluster[graph.sender]), cluster


def hierarchy(problem: Problem, levels: int | None = None) -> tuple[list[Graph], list[Integers]]:
    """Return the graphs of all levels, finest first, and the cluster of each member of a level.

    Sizes decrease by a constant factor from level to level, down to `COARSEST`. Without `levels`,
    the number of levels is the smallest for which this factor is at most 2^D.
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
    """Return the means of values (K, n) over the members of each cluster."""
    members = np.bincount(cluster)
    return np.column_stack([np.bincount(cluster, column) / members for column in values.T])


def _complete(points: Floats) -> Graph:
    return Graph(points, *np.divmod(np.arange(len(points) ** 2), len(points)), complete=True)


def _graph(points: Floats, receiver: Integers, sender: Integers) -> Graph:
    loops = receiver == sender
    pairs = np.unique(receiver[~loops] * len(points) + sender[~loops])
    return Graph(points, *np.divmod(pairs, len(points)), complete=False)

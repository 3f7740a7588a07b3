"""Bandwidth-reducing order of unknowns, the same on every machine."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, csr_array
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee


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
        own = graph if parts == 1 else graph[nodes][:, nodes]
        longer = block_array([[own, end.T], [end, None]], format="csr")
        order = reverse_cuthill_mckee(longer, symmetric_mode=True)
        orders.append(nodes[order[order < len(nodes)]])
    return np.concatenate(orders).astype(np.int32)

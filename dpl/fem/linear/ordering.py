"""An order of nodes in which neighbours are near, the same on every machine."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, csr_array
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee


def reduce_bandwidth(graph: csr_array) -> NDArray[np.int32]:
    """Return the reverse Cuthill-McKee order (n,) of a symmetric graph (George 1971).

    SciPy's begins at the node of lowest degree which an unstable sort happens to put first: at
    another one on another processor. So each part of the graph gets a loose end, at the first of
    its nodes of lowest degree; that is where it begins, and what is left out afterwards.
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

"""A pneumatic finger: a block of hexahedra with a closed chamber."""

import math
from collections.abc import Sequence

import numpy as np
import skfem

from dpl.fem.mesh.generators import grid
from dpl.fem.mesh.regions import Box, facets_in


def finger(
    size: Sequence[float] = (0.16, 0.016, 0.016), cells: Sequence[int] = (16, 4, 4)
) -> skfem.Mesh:
    """Return a mesh of the box [0, size] with a chamber near its upper side (z).

    One cell is wall on each side of the chamber, and half of the cells are below it. Pressure in
    the chamber stretches the upper side, so that the finger bends downwards.

    Tag: "chamber" (facets).

    Args:
        size: Lengths along the finger, across it and upwards [m].
        cells: Numbers of cells along these sides, at least 3, 3 and 4, the last one even.
    """
    if len(cells) != 3 or cells[0] < 3 or cells[1] < 3 or cells[2] < 4 or cells[2] % 2:
        raise ValueError(f"cells = {list(cells)} must be at least [3, 3, 4], the last one even")
    inside = math.prod((cells[0] - 3, cells[1] - 3, cells[2] // 2 - 2))  # nodes of the chamber
    nodes = [n + 1 for n in cells]
    block = grid({"hexahedron": skfem.MeshHex}, size, nodes, "hexahedron", unused=inside)
    cell = np.array(size, dtype=np.float64) / cells
    lower = cell * [1, 1, cells[2] // 2]
    upper = np.array(size) - cell
    centres = block.p[:, block.t].mean(axis=1).T
    is_wall = ~((centres > lower) & (centres < upper)).all(axis=1)
    mesh = block.restrict(np.flatnonzero(is_wall))
    return mesh.with_boundaries({"chamber": facets_in(Box(list(lower), list(upper)), mesh)})

"""Structured meshes of boxes, rectangles and a finger, and measures of meshes.

Meshes are objects of scikit-fem with coordinates in metres.
"""

import math
from collections.abc import Sequence

import numpy as np
import skfem
from numpy.typing import NDArray

from dpl.fem.mesh.regions import Box, facets_in
from dpl.system.memory import refuse_mesh

SMALLEST, LARGEST = 1e-12, 1e12  # sides of a body [m]
MAX_ASPECT = 1e6  # longest over shortest side
CELLS = {  # by dimension
    2: {"quad": skfem.MeshQuad, "triangle": skfem.MeshTri},
    3: {"hexahedron": skfem.MeshHex, "tetra": skfem.MeshTet},
}


def box(size: Sequence[float], nodes: Sequence[int], cell: str = "hexahedron") -> skfem.Mesh:
    """Return a mesh of the box [0, size] with equal cells.

    Node numbers increase slowest along the side with the most nodes and fastest along the side with
    the fewest. This gives the stiffness matrix a small bandwidth.

    Args:
        size: Lengths of the 3 sides [m].
        nodes: Numbers of vertices along the sides, at least 2.
        cell: "hexahedron", or "tetra" for six Kuhn tetrahedra per hexahedron.
    """
    return grid(3, size, nodes, cell)


def rectangle(size: Sequence[float], nodes: Sequence[int], cell: str = "quad") -> skfem.Mesh:
    """Return a mesh of the rectangle [0, size] with equal cells; nodes are numbered as in `box`.

    Args:
        size: Lengths of the 2 sides [m].
        nodes: Numbers of vertices along the sides, at least 2.
        cell: "quad", or "triangle" for two triangles per quadrilateral.
    """
    return grid(2, size, nodes, cell)


def finger(
    size: Sequence[float] = (0.16, 0.016, 0.016), cells: Sequence[int] = (16, 4, 4)
) -> skfem.Mesh:
    """Return a mesh of a pneumatic finger: a box [0, size] with a chamber near its upper side (z).

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
    block = grid(3, size, nodes, "hexahedron", unused=inside)
    cell = np.array(size, dtype=np.float64) / cells
    lower = cell * [1, 1, cells[2] // 2]
    upper = np.array(size) - cell
    centres = block.p[:, block.t].mean(axis=1).T
    is_wall = ~((centres > lower) & (centres < upper)).all(axis=1)
    mesh = block.restrict(np.flatnonzero(is_wall))
    return mesh.with_boundaries({"chamber": facets_in(Box(list(lower), list(upper)), mesh)})


def grid(
    dim: int, size: Sequence[float], nodes: Sequence[int], cell: str, *, unused: int = 0
) -> skfem.Mesh:
    """Return a mesh of a box with equal cells, of which the caller removes `unused` nodes."""
    if cell not in CELLS[dim]:
        raise ValueError(f"cell = {cell!r} must be one of {', '.join(CELLS[dim])}")
    if len(size) != dim or not all(SMALLEST <= s <= LARGEST for s in size):
        span = f"between {SMALLEST:g} and {LARGEST:g}"
        raise ValueError(f"size = {list(size)} must be {dim} positive lengths {span} [m]")
    if max(size) > MAX_ASPECT * min(size):
        raise ValueError(f"size = {list(size)} must have a ratio of at most {MAX_ASPECT:g}")
    if len(nodes) != dim or not all(n == int(n) and n >= 2 for n in nodes):
        raise ValueError(f"nodes = {list(nodes)} must be {dim} integers of at least 2")
    refuse_mesh(math.prod(map(int, nodes)) - unused, "mesh.nodes")
    sides = [np.linspace(0.0, s, int(n)) for s, n in zip(size, nodes, strict=True)]
    mesh = CELLS[dim][cell].init_tensor(*sides)
    order = np.lexsort([mesh.p[axis] for axis in np.argsort(nodes, kind="stable")])
    return type(mesh)(np.ascontiguousarray(mesh.p[:, order]), np.argsort(order)[mesh.t])


def longest_side(points: NDArray[np.float64]) -> float:
    """Return L [m], the longest side of the object-aligned bounding box of points (N, D) [m].

    The box is the smaller one of two: that along the coordinate axes, which is exact for bodies
    without principal directions (a cube), and that along the principal directions.
    """
    centred = points - points.mean(axis=0)
    principal = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
    along, turned = np.ptp(points, axis=0), np.ptp(principal, axis=0)
    larger = np.prod(along) > np.prod(turned) * (1 + 1e-9)
    return float((turned if larger else along).max())


def near_origin(mesh: skfem.Mesh) -> tuple[skfem.Mesh, NDArray[np.float64]]:
    """Return a mesh [m] moved towards zero by integer multiples of its size, and its origin.

    The origin (D,) [m] is in the coordinates of `mesh`. A mesh that contains zero is not moved.
    """
    low, high = mesh.p.min(axis=1), mesh.p.max(axis=1)
    size = (high - low).max()
    origin = size * np.trunc((low / 2 + high / 2) / size) + 0.0
    return mesh.translated(-origin), origin


def aspect_ratio(mesh: skfem.Mesh) -> NDArray[np.float64]:
    """Return the aspect ratio of each cell, (E,), at least 1.

    It is the condition number of the map from a regular cell (square, cube, equilateral triangle,
    regular tetrahedron) to the cell at its centre, and does not depend on the order of nodes. A
    brick has its longest over its shortest side, a Kuhn tetrahedron of a cube 2.4, half a square
    1.7.
    """
    shape = mesh.elem.refdom
    centre = shape.p.mean(axis=1, keepdims=True)
    J = mesh.mapping().DF(centre)[..., 0].transpose(2, 0, 1)  # (E, D, D)
    if shape.name in ("Triangular", "Tetrahedral"):
        # the reference cell is mapped to the regular cell, whose edges have equal lengths
        J = J @ np.linalg.inv(np.linalg.cholesky((np.eye(mesh.dim()) + 1) / 2).T)
    lengths = np.linalg.svd(J, compute_uv=False)
    with np.errstate(divide="ignore"):
        return lengths[:, 0] / lengths[:, -1]

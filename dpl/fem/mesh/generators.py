"""Meshes (scikit-fem's own classes, in metres): grids, measures, and the door to the rest.

Files are read in `dpl.fem.mesh.reading` and held to `dpl.fem.mesh.validation`; regions
are in `dpl.fem.mesh.regions`.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import skfem
from numpy.typing import NDArray

from dpl.system.memory import refuse_mesh

SMALLEST, LARGEST = 1e-12, 1e12  # sides of a body [m]
THINNEST = 1e6  # longest over shortest side


def box(size: Sequence[float], nodes: Sequence[int], cell: str = "hexahedron") -> skfem.Mesh:
    """Return a box [0, size] of equal cells.

    Nodes are numbered along the sides from the one with the most nodes (slowest) to the one with
    the fewest, which makes the stiffness matrix banded.

    Args:
        size: Lengths of the sides [m], 3 of them.
        nodes: Vertices along each side, 2 or more.
        cell: "hexahedron", or "tetra" for six Kuhn tetrahedra a cell.

    Raises:
        ValueError: A size or a number of nodes is out of range, or `cell` is unknown.
        MemoryError: So many nodes do not fit.
    """
    kinds = {"hexahedron": skfem.MeshHex, "tetra": skfem.MeshTet}
    return _grid(kinds, size, nodes, cell)


def rectangle(size: Sequence[float], nodes: Sequence[int], cell: str = "quad") -> skfem.Mesh:
    """Return a rectangle [0, size] of equal cells, for plane strain; arguments as in `box`.

    Args:
        size: Lengths of the sides [m], 2 of them.
        nodes: Vertices along each side, 2 or more.
        cell: "quad", or "triangle" for two triangles a cell.

    Raises:
        ValueError: A size or a number of nodes is out of range, or `cell` is unknown.
        MemoryError: So many nodes do not fit.
    """
    kinds = {"quad": skfem.MeshQuad, "triangle": skfem.MeshTri}
    return _grid(kinds, size, nodes, cell)


def _grid(
    kinds: Mapping[str, type[skfem.Mesh]], size: Sequence[float], nodes: Sequence[int], cell: str
) -> skfem.Mesh:
    if cell not in kinds:
        raise ValueError(f"cell = {cell!r} must be one of {', '.join(kinds)}")
    dim = kinds[cell].elem().dim
    if len(size) != dim or not all(SMALLEST <= s <= LARGEST for s in size):
        span = f"between {SMALLEST:g} and {LARGEST:g}"
        raise ValueError(f"size = {list(size)} must be {dim} positive lengths {span} [m]")
    if max(size) > THINNEST * min(size):
        raise ValueError(
            f"size = {list(size)} must be lengths that differ by {THINNEST:g} times at most"
        )
    if len(nodes) != dim or not all(n == int(n) and n >= 2 for n in nodes):
        raise ValueError(f"nodes = {list(nodes)} must be {dim} whole numbers of 2 or more")
    refuse_mesh(math.prod(map(int, nodes)), "mesh.nodes")
    sides = [np.linspace(0.0, s, int(n)) for s, n in zip(size, nodes, strict=True)]
    mesh = kinds[cell].init_tensor(*sides)
    order = np.lexsort([mesh.p[axis] for axis in np.argsort(nodes, kind="stable")])
    return type(mesh)(np.ascontiguousarray(mesh.p[:, order]), np.argsort(order)[mesh.t])


def longest_side(points: NDArray[np.float64]) -> float:
    """Return L [m], the longest side of the object-aligned bounding box of points (N, D) [m].

    Of the box along the axes and the one along the principal directions the smaller counts: the
    first serves bodies without preferred directions (a cube), the second bodies that lie askew.
    """
    centred = points - points.mean(axis=0)
    principal = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
    boxes = [np.ptp(points, axis=0), np.ptp(principal, axis=0)]
    return float(
        min(boxes, key=lambda sides: np.prod(sides) * (1 + 1e-9 * (sides is boxes[1]))).max()
    )


def near_origin(mesh: skfem.Mesh) -> tuple[skfem.Mesh, NDArray[np.float64]]:
    """Return a body moved towards the origin by whole multiples of its size, and by how much.

    A body that lies about the origin stays where it is, to the last bit.

    Args:
        mesh: The body [m].

    Returns:
        The mesh, and where its origin is in the coordinates of `mesh`, (D,) [m].
    """
    low, high = mesh.p.min(axis=1), mesh.p.max(axis=1)
    size = (high - low).max()
    origin = size * np.trunc((low / 2 + high / 2) / size) + 0.0
    return mesh.translated(-origin), origin


def aspect_ratio(mesh: skfem.Mesh) -> NDArray[np.float64]:
    """Return the longest over the shortest length of each cell, (E,), 1 or more.

    The lengths are the singular values of the map, taken at the cell's centre, from a regular cell
    (square, cube, equilateral triangle, regular tetrahedron) to the cell, so the order of nodes
    does not matter. A brick gives its longest over its shortest side, a Kuhn tetrahedron of a cube
    2.4 and half a square 1.7; slivers and the cells of thin plates give large numbers.
    """
    shape = mesh.elem.refdom
    centre = shape.p.mean(axis=1, keepdims=True)
    J = mesh.mapping().DF(centre)[..., 0].transpose(2, 0, 1)  # (E, D, D)
    if shape.name in ("Triangular", "Tetrahedral"):
        # edges of the regular cell: those of the reference cell, made equally long and inclined
        J = J @ np.linalg.inv(np.linalg.cholesky((np.eye(mesh.dim()) + 1) / 2).T)
    lengths = np.linalg.svd(J, compute_uv=False)
    with np.errstate(divide="ignore"):
        return lengths[:, 0] / lengths[:, -1]

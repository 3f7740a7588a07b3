"""Meshes (scikit-fem's own classes, in metres), regions of their nodes, files in and out."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skfem.io.meshio import from_meshio, to_meshio

CELLS = {  # meshio's names of what can be solved, best first
    "hexahedron": (3, 8),
    "hexahedron27": (3, 27),
    "tetra": (3, 4),
    "tetra10": (3, 10),
    "quad": (2, 4),
    "quad9": (2, 9),
    "triangle": (2, 3),
    "triangle6": (2, 6),
}


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
    """
    kinds = {"quad": skfem.MeshQuad, "triangle": skfem.MeshTri}
    return _grid(kinds, size, nodes, cell)


def _grid(
    kinds: Mapping[str, type[skfem.Mesh]], size: Sequence[float], nodes: Sequence[int], cell: str
) -> skfem.Mesh:
    if cell not in kinds:
        raise ValueError(f"cell = {cell!r} must be one of {', '.join(kinds)}")
    dim = kinds[cell].elem().dim
    if len(size) != dim or not all(math.isfinite(s) and s > 0 for s in size):
        raise ValueError(f"size = {list(size)} must be {dim} positive lengths [m]")
    if len(nodes) != dim or not all(n == int(n) and n >= 2 for n in nodes):
        raise ValueError(f"nodes = {list(nodes)} must be {dim} whole numbers of 2 or more")
    sides = [np.linspace(0.0, s, int(n)) for s, n in zip(size, nodes, strict=True)]
    mesh = kinds[cell].init_tensor(*sides)
    order = np.lexsort([mesh.p[axis] for axis in np.argsort(nodes, kind="stable")])
    return _renumbered(mesh, order)


def _renumbered(mesh: skfem.Mesh, order: NDArray[np.int_]) -> skfem.Mesh:
    """Return the mesh whose node k is node order[k] of the old one; nodes not named are dropped."""
    new = np.full(mesh.p.shape[1], -1)
    new[order] = np.arange(len(order))
    return type(mesh)(np.ascontiguousarray(mesh.p[:, order]), new[mesh.t])


def load(path: str | Path) -> skfem.Mesh:
    """Return the mesh of any file that meshio reads, checked.

    The cells of the highest dimension are kept, nodes that no cell uses are dropped, and a planar
    mesh with a third coordinate of zero becomes a 2D one.

    Args:
        path: A file (.msh, .vtu, .vtk, .inp, ...), coordinates in metres.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file cannot be read, or its mesh cannot be solved; the message says why.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such mesh file")
    if path.suffix == ".vtu" and path.read_bytes().count(b"<Piece") > 1:
        raise ValueError(f"{path}: holds several pieces, of which meshio keeps one; join them")
    try:
        raw = meshio.read(path)
    except (Exception, SystemExit) as error:  # meshio calls sys.exit on files it cannot read
        known = isinstance(error, Exception) and str(error).strip()
        reason = known or "meshio does not know this format"
        raise ValueError(f"{path}: cannot be read as a mesh: {reason}") from error
    try:
        return check(_solid(raw))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _solid(raw: meshio.Mesh) -> skfem.Mesh:
    found = {block.type for block in raw.cells if len(block.data)}
    kinds = [kind for kind in CELLS if kind in found]
    if not kinds:
        raise ValueError(
            f"holds no cells that can be solved ({', '.join(sorted(found)) or 'none'})"
        )
    dim = max(CELLS[kind][0] for kind in kinds)
    kinds = [kind for kind in kinds if CELLS[kind][0] == dim]
    if len(kinds) > 1:
        raise ValueError(f"mixes {' and '.join(kinds)} cells; convert them to one kind")
    points = np.asarray(raw.points, dtype=np.float64)
    cells = np.concatenate([block.data for block in raw.cells if block.type == kinds[0]])
    if not np.isfinite(points).all():
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        raise ValueError(f"coordinates of node {bad[0]} are not finite ({len(bad)} such nodes)")
    if cells.min() < 0 or cells.max() >= len(points):
        raise ValueError(
            f"cells name nodes {cells.min()} to {cells.max()}, there are 0 to {len(points) - 1}"
        )
    if dim == 2 and points.shape[1] == 3:
        if np.ptp(points[:, 2]) > 1e-9 * np.ptp(points):
            raise ValueError("is a surface in space; a 2D mesh must lie in the plane z = 0")
        points = points[:, :2]
    used, cells = np.unique(cells, return_inverse=True)
    raw = meshio.Mesh(points[used], [(kinds[0], cells.reshape(-1, CELLS[kinds[0]][1]))])
    return from_meshio(raw)


def check(mesh: skfem.Mesh) -> skfem.Mesh:
    """Return the mesh as it is, if it can be solved.

    Raises:
        ValueError: Inverted or flat cells, nodes in one place, or a body in several pieces.
    """
    vertices = mesh.p[:, : mesh.t.max() + 1]
    X = skfem.quadrature.get_quadrature(mesh.elem.refdom, 2 * mesh.elem.maxdeg)[0]
    # The sign tells only in which order nodes are listed. No detDF: it raises where it is zero.
    volume = np.linalg.det(mesh.mapping().DF(X).transpose(2, 3, 0, 1))  # (E, Q)
    volume = volume * np.sign(np.median(volume, axis=1, keepdims=True))
    diameter = np.ptp(vertices, axis=1).max()
    smallest, nothing = volume.min(axis=1), 1e-14 * diameter ** mesh.dim()
    for flaw, where in (("inverted", smallest < -nothing), ("of no volume", smallest <= nothing)):
        bad = np.flatnonzero(where)
        if len(bad):
            named = ", ".join(map(str, bad[:5])) + (", ..." if len(bad) > 5 else "")
            raise ValueError(f"{len(bad)} cells are {flaw}: {named}")
    boundary = skfem.FacetBasis(mesh, mesh.elem(), intorder=6)
    flux = (boundary.normals * boundary.global_coordinates()).sum(axis=0) * boundary.dx
    body = skfem.Basis(mesh, mesh.elem(), intorder=6).dx.sum()
    if abs(flux.sum() / mesh.dim() - body) > 1e-9 * body:
        raise ValueError("cells overlap: some are inverted or listed twice")
    rounded = np.round(vertices / (1e-9 * diameter)).T
    twins = len(rounded) - len(np.unique(rounded, axis=0))
    if twins:
        raise ValueError(f"{twins} nodes coincide with others; merge them, or the body is cracked")
    links = np.ones(mesh.t[1:].size)
    graph = coo_array((links, (np.tile(mesh.t[0], len(mesh.t) - 1), mesh.t[1:].ravel())))
    graph.resize((vertices.shape[1],) * 2)
    pieces, member = connected_components(graph, directed=False)
    if pieces > 1:
        sizes = ", ".join(map(str, np.sort(np.bincount(member))[::-1]))
        raise ValueError(
            f"the body is in {pieces} pieces (of {sizes} nodes); join or separate them"
        )
    return mesh


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


@dataclass(frozen=True)
class Plane:
    """Region: the nodes on a plane across a coordinate axis.

    Attributes:
        axis: 0, 1 or 2 for x, y or z.
        at: Where the plane cuts the axis [m], or "min" or "max" for the body's first or last node.
    """

    axis: int
    at: float | str

    def __post_init__(self) -> None:
        """Check the attributes.

        Raises:
            ValueError: `axis` or `at` is none of the above.
        """
        if self.axis not in (0, 1, 2):
            raise ValueError(f"axis = {self.axis} must be 0, 1 or 2")
        if isinstance(self.at, str) and self.at not in ("min", "max"):
            raise ValueError(f"at = {self.at!r} must be min, max or a coordinate [m]")

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which of points (N, D) [m] lie in the region, (N,)."""
        if self.axis >= points.shape[1]:
            raise ValueError(f"axis = {self.axis} does not exist in {points.shape[1]}D")
        x = points[:, self.axis]
        at = {"min": x.min(), "max": x.max()}[self.at] if isinstance(self.at, str) else self.at
        return np.abs(x - at) <= 1e-6 * np.ptp(points, axis=0).max()


@dataclass(frozen=True)
class Box:
    """Region: the nodes in a box along the axes, its faces included.

    Attributes:
        lower, upper: Opposite corners [m], D of them.
    """

    lower: Sequence[float]
    upper: Sequence[float]

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which of points (N, D) [m] lie in the region, (N,)."""
        slack = 1e-6 * np.ptp(points, axis=0).max()
        inside = (points >= np.array(self.lower) - slack) & (points <= np.array(self.upper) + slack)
        return inside.all(axis=1)


def save(path: Path, mesh: skfem.Mesh, fields: Mapping[str, NDArray[np.float64]]) -> None:
    """Write a mesh with fields at its vertices, (N,) or (N, D), in any format of meshio."""
    flat = to_meshio(mesh)
    vertices = mesh.p.shape[1]
    points = np.pad(flat.points, ((0, 0), (0, 3 - flat.points.shape[1])))
    data = {
        name: np.pad(field[:vertices], ((0, 0), (0, 3 - field.shape[1])))
        if field.ndim == 2
        else field[:vertices]
        for name, field in fields.items()
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    meshio.write(path, meshio.Mesh(points, flat.cells, point_data=data))

"""Validation of meshes: errors are one line with the numbers of the invalid nodes or cells."""

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skfem.helpers import det

# Degree of exactness of the densest quadrature that `dpl.fem.assembly.elements` uses.
ORDERS = {"Triangular": 4, "Quadrilateral": 5, "Tetrahedral": 4, "Hexahedral": 5}
CROWD = 100  # coincident nodes above which pairs are not searched, because there are too many
LARGEST = 1e50  # limit of coordinates [m], so that volumes do not overflow

Numbers = NDArray[np.int_]


def check_mesh(mesh: skfem.Mesh, *, numbers: Numbers | None = None) -> skfem.Mesh:
    """Return the mesh unchanged if it is valid.

    Args:
        mesh: The mesh; cells may have either orientation.
        numbers: Numbers of its vertices in messages, (N,); default: their index.

    Raises:
        ValueError: The first of these errors, with its cells or nodes: coordinates that are not
            finite or above `LARGEST`, nodes without a cell, cells that list a node twice, duplicate
            cells, inverted or flat cells, sides shared by three cells, cells folded over their
            neighbours, coincident nodes, hanging nodes, sides that overlap without being equal,
            several disconnected pieces, parts that touch only in nodes or edges.
    """
    numbers = np.arange(mesh.p.shape[1]) if numbers is None else numbers
    check_coordinates(mesh.p.T, numbers)
    unused = np.setdiff1d(np.arange(mesh.nvertices), mesh.t)
    if len(unused):
        raise ValueError(f"{len(unused)} nodes belong to no cell: {_nodes(unused, numbers)}")
    _check_lists(mesh)
    orientation = _check_volumes(mesh)
    _check_sides(mesh, orientation)
    _check_coincidence(mesh, numbers)
    _check_contacts(mesh, numbers)
    _check_joints(mesh, numbers)
    return mesh


def listed(numbers: Numbers | list[str], most: int = 5) -> str:
    """Return a text with the first numbers."""
    return ", ".join(map(str, numbers[:most])) + (", ..." if len(numbers) > most else "")


def check_coordinates(points: NDArray[np.float64], numbers: Numbers) -> None:
    """Raise a ValueError unless coordinates (N, D) are finite and at most `LARGEST`."""
    for bad, flaw in (
        (~np.isfinite(points).all(axis=1), "not finite"),
        ((np.abs(points) > LARGEST).any(axis=1), f"above {LARGEST:.0e} m"),
    ):
        if bad.any():
            where = _nodes(np.flatnonzero(bad), numbers)
            raise ValueError(f"coordinates of {bad.sum()} nodes are {flaw}: {where}")


def _check_lists(mesh: skfem.Mesh) -> None:
    ordered = np.sort(mesh.t, axis=0)
    bad = np.flatnonzero((np.diff(ordered, axis=0) == 0).any(axis=0))
    if len(bad):
        raise ValueError(f"{len(bad)} cells list a node twice: {listed(bad)}")
    order = np.lexsort(ordered)
    same = (ordered[:, order[1:]] == ordered[:, order[:-1]]).all(axis=0)
    if same.any():
        pairs = np.sort([order[:-1][same], order[1:][same]], axis=0)
        raise ValueError(f"{same.sum()} cells are listed twice: {_pairs(pairs)}")


def _check_volumes(mesh: skfem.Mesh) -> NDArray[np.float64]:
    """Return the orientation of each cell, (E,): 1 or -1."""
    shape = mesh.elem.refdom
    X = skfem.quadrature.get_quadrature(shape, 0 if mesh.affine else ORDERS[shape.name])[0]
    J = det(mesh.mapping().DF(X))  # (E, Q); `detDF` would raise where it is zero
    sense = np.sign(np.median(J, axis=1))
    smallest = (J * sense[:, None]).min(axis=1)
    size = np.ptp(mesh.p[:, mesh.t], axis=1).max(axis=0)  # (E,)
    # bound of the rounding error, from the size of the cell and its distance from the origin
    roundoff = (1e-12 * size + 1e-15 * np.abs(mesh.p).max()) * size ** (mesh.dim() - 1)
    for flaw, where in (("inverted", smallest < -roundoff), ("of no volume", smallest <= roundoff)):
        bad = np.flatnonzero(where)
        if len(bad):
            raise ValueError(f"{len(bad)} cells are {flaw}: {listed(bad)}")
    return sense


def _check_sides(mesh: skfem.Mesh, sense: NDArray[np.float64]) -> None:
    """Raise unless a side has at most two cells, and these lie on opposite faces of it."""
    shared = np.bincount(mesh.t2f.ravel())
    crowded = np.flatnonzero((shared > 2)[mesh.t2f].any(axis=0))
    if len(crowded):
        raise ValueError(f"a side is shared by three or more cells: {listed(crowded, 8)}")
    signs = np.stack([_outward(mesh, side) for side in mesh.elem.refdom.facets]) * sense
    total = np.bincount(mesh.t2f.ravel(), weights=signs.ravel())
    folded = (shared == 2) & (np.abs(total) > 1)  # both cells lie on the same face of the side
    if folded.any():
        some = folded[mesh.t2f].any(axis=0)
        whole = some & (folded | (shared == 1))[mesh.t2f].all(axis=0)
        bad = np.flatnonzero(whole if whole.any() else some)
        raise ValueError(
            f"{len(bad)} cells are inverted, folded over their neighbours: {listed(bad)}"
        )


def _outward(mesh: skfem.Mesh, side: list[int]) -> NDArray[np.int_]:
    """Return the orientation of a local side in all cells, (E,): 1 or -1.

    It is the sense of rotation of its vertices, from that of the lowest number, seen from outside
    the cell. The two cells of a side must have opposite orientations.
    """
    p = mesh.elem.refdom.p[:, side]  # (D, corners)
    along, away = p[:, 1] - p[:, 0], p.mean(axis=1) - mesh.elem.refdom.p.mean(axis=1)
    normal = np.array([along[1], -along[0]]) if len(p) == 2 else np.cross(along, p[:, -1] - p[:, 0])
    t = mesh.t[side]
    first, cells = t.argmin(axis=0), np.arange(t.shape[1])
    if len(p) == 2:
        sense = np.where(first == 0, 1, -1)
    else:
        after, before = t[(first + 1) % len(t), cells], t[(first - 1) % len(t), cells]
        sense = np.where(after > before, 1, -1)
    return sense * int(np.sign(normal @ away))


def _check_coincidence(mesh: skfem.Mesh, numbers: Numbers) -> None:
    """Raise for coincident nodes, including those of quadratic edges."""
    close = 1e-9 * np.ptp(mesh.p, axis=1).max()
    grid = np.round(mesh.p / (10 * close))
    _, place, count = np.unique(grid, axis=1, return_inverse=True, return_counts=True)
    if count.max() > CROWD:
        bad = np.flatnonzero(place.ravel() == count.argmax())
        raise ValueError(
            f"{len(bad)} nodes coincide in one place: {_nodes(bad, numbers)}; merge them, "
            "or the body is cracked"
        )
    twins = cKDTree(mesh.p.T).query_pairs(close, output_type="ndarray")
    if len(twins):
        known = twins[(twins < len(numbers)).all(axis=1)]
        where = f": {_pairs(numbers[known[np.lexsort(known.T[::-1])]].T)}" if len(known) else ""
        raise ValueError(
            f"{len(np.unique(twins[:, 1]))} nodes coincide with others{where}; merge them, "
            "or the body is cracked"
        )


def _check_contacts(mesh: skfem.Mesh, numbers: Numbers) -> None:
    """Raise if the boundary touches itself other than in common vertices.

    If two cells meet in sides that are not equal, both sides belong to the boundary, and a vertex
    of one lies inside the other (hanging node). Triangles that split a quadrilateral along
    different diagonals overlap without hanging nodes; they share two vertices.
    """
    facets = mesh.boundary_facets()
    owners = mesh.f2t[0, facets]
    local = (mesh.t2f[:, owners] == facets).argmax(axis=0)
    # vertices of boundary facets in cyclic order, (corners, F)
    around = mesh.t[np.array(mesh.elem.refdom.facets).T[:, local], owners]
    sides = mesh.p[:, around]  # (D, corners, F)
    vertices = np.unique(around)
    hanging = np.unique(vertices[_contacts(sides, mesh.p[:, vertices], -1e-6)[1]])
    if len(hanging):
        raise ValueError(
            f"{len(hanging)} nodes lie inside a side of a cell that does not have them as vertices "
            f"(hanging nodes): {_nodes(hanging, numbers)}"
        )
    if mesh.elem.refdom.name == "Tetrahedral":
        inner = sides[:, 0] * 0.45 + sides[:, 1] * 0.33 + sides[:, 2] * 0.22  # on no diagonal
        pair = np.stack(_contacts(sides, inner, 0.01))
        common = (around[:, None, pair[0]] == around[None, :, pair[1]]).sum(axis=(0, 1))
        cells = mesh.f2t[0, facets[pair[:, common == 2]]]
        if cells.size:
            raise ValueError(
                "sides of cells overlap without being the same, their vertices differ: "
                + _pairs(np.unique(np.sort(cells, axis=0), axis=1))
            )


def _contacts(
    sides: NDArray[np.float64], points: NDArray[np.float64], margin: float
) -> tuple[Numbers, Numbers]:
    """Return the indices of sides (D, corners, F) and points (D, P) where a point lies on a side.

    The distance of the point from the edges is above `margin` (relative to the size of the side),
    and the point is not a vertex of the side.
    """
    middle = sides.mean(axis=1)
    radius = np.sqrt(((sides - middle[:, None]) ** 2).sum(axis=0).max(axis=0))
    near = cKDTree(points.T).query_ball_point(middle.T, radius * (1 + 1e-9))
    side = np.repeat(np.arange(len(near)), [len(found) for found in near])
    point = np.concatenate(near).astype(np.int64)
    corners = sides[:, :, side] - points[:, None, point]
    clear = np.sqrt((corners**2).sum(axis=0)).min(axis=0) > 1e-3 * radius[side]
    side, point = side[clear], point[clear]
    on = _distance(sides[:, :, side], points[:, point], margin) <= 1e-5 * radius[side]
    return side[on], point[on]


def _distance(
    sides: NDArray[np.float64], points: NDArray[np.float64], margin: float
) -> NDArray[np.float64]:
    """Return distances (P,) of points (D, P) to segments, triangles or quads (D, corners, P).

    The distance is infinite if the parameters of the closest point are outside the margin. For
    warped (bilinear) quads Gauss-Newton finds them; for the others its first step is exact.
    """
    corners = sides.shape[1]
    a, b, d = sides[:, 0], sides[:, 1], sides[:, -1] if corners > 2 else sides[:, 0]
    twist = a - b + sides[:, 2] - d if corners == 4 else np.zeros_like(a)
    s = t = np.full(points.shape[1], 0.5 if corners == 4 else 0.0)
    for _ in range(6 if corners == 4 else 1):
        ds, dt = b - a + t * twist, d - a + s * twist
        gap = points - (a + s * (b - a) + t * (d - a) + s * t * twist)
        ss, st, tt = (ds * ds).sum(axis=0), (ds * dt).sum(axis=0), (dt * dt).sum(axis=0)
        fs, ft = (ds * gap).sum(axis=0), (dt * gap).sum(axis=0)
        if corners == 2:
            s = s + fs / ss
        else:
            area = ss * tt - st * st
            s, t = s + (tt * fs - st * ft) / area, t + (ss * ft - st * fs) / area
    gap = points - (a + s * (b - a) + t * (d - a) + s * t * twist)
    within = (s >= margin) & (s <= 1 - margin)
    if corners > 2:
        within &= (t >= margin) & ((t if corners == 4 else s + t) <= 1 - margin)
    return np.where(within, np.sqrt((gap**2).sum(axis=0)), np.inf)


def _check_joints(mesh: skfem.Mesh, numbers: Numbers) -> None:
    """Raise unless cells are connected by sides: parts that touch in nodes or edges are hinged."""
    links = mesh.f2t[:, mesh.f2t[1] >= 0]
    graph = coo_array((np.ones(links.shape[1]), links), shape=(mesh.nelements, mesh.nelements))
    parts, member = connected_components(graph, directed=False)
    if parts > 1:
        sizes = listed(np.sort(np.bincount(member))[::-1], 8)
        pairs = np.stack([mesh.t.ravel(), np.tile(member, len(mesh.t))])
        touching = np.flatnonzero(np.bincount(np.unique(pairs, axis=1)[0]) > 1)
        where = f" that touch only in nodes or edges: {_nodes(touching, numbers)}"
        raise ValueError(
            f"the body is in {parts} parts (of {sizes} cells){where if len(touching) else ''}; "
            "join them by sides of cells or separate them"
        )


def _nodes(vertices: Numbers, numbers: Numbers) -> str:
    return listed(numbers[vertices[vertices < len(numbers)]])


def _pairs(pairs: Numbers) -> str:
    """Return a text with the first pairs of (2, n)."""
    return listed([f"{a} and {b}" for a, b in pairs.T[:5]], 4)

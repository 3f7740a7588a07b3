"""A propeller of structured hexahedra, conforming from the bore to the tips."""

import math
from collections.abc import Sequence

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import coo_array

from dpl.fem.linear.ordering import reduce_bandwidth
from dpl.fem.mesh.regions import Cylinder, facets_in
from dpl.fem.mesh.validation import check_mesh
from dpl.system.memory import refuse_mesh

Points = NDArray[np.float64]  # (3, ...)


def propeller(
    diameter: float = 1.0,
    blades: int = 5,
    *,
    hub_diameter: Sequence[float] = (0.1, 0.2),
    hub_length: float = 0.18,
    pitch_angle: Sequence[float] = (60.0, 25.0),
    chord: Sequence[float] = (0.21, 0.1),
    thickness: Sequence[float] = (0.05, 0.012),
    cells: Sequence[int] = (3, 2, 2, 6, 25),
) -> skfem.Mesh:
    """Return a hexahedral mesh of a propeller about the x axis; the first blade points along y.

    The hub is a ring whose cells follow the helix of the blade roots, so that blades and hub share
    nodes. The sections of a blade are lens-shaped and lie on cylinders about the x axis. At the
    root the chord spans the whole length of the hub.

    The default mesh has 2,550 cells and 4,025 nodes (12,075 degrees of freedom, as in the paper),
    175 of them in the bore. B blades and cells (t, g, w, c, s) give
    B (t + g) (w + 1) (c + 1) + B (t + 1) (c + 1) s nodes, in reverse Cuthill-McKee order, which
    reduces the bandwidth of the stiffness matrix.

    Tags: "bore" (facets), "hub" and "blades" (cells).

    Args:
        diameter: Diameter of the circle of the tips [m].
        blades: Number of blades, at least 2.
        hub_diameter: Diameters of the bore for the shaft and of the hub [m].
        hub_length: Length of the hub along the shaft [m].
        pitch_angle: Angles of the sections to the plane of rotation at root and tip [degrees]. The
            pitch 2 pi r tan(pitch angle) is linear along the blade.
        chord: Width of a blade half-way between hub and tip, and at the tip [m].
        thickness: Largest thickness of the sections at root and tip [m].
        cells: Numbers of cells through a blade, on the hub between two blades, through the wall of
            the hub, along the chord (and the hub), and along the blade.
    """
    for key, length in (("diameter", diameter), ("hub_length", hub_length)):
        if not 0 < length < math.inf:
            raise ValueError(f"{key} = {length} must be a positive length [m]")
    for key, pair, bound, kind in (
        ("hub_diameter", hub_diameter, diameter, f"ascending lengths below {diameter} [m]"),
        ("pitch_angle", pitch_angle, 90, "angles between 0 and 90 [degrees]"),
        ("chord", chord, math.inf, "positive lengths [m]"),
        ("thickness", thickness, math.inf, "positive lengths [m]"),
    ):
        if len(pair) != 2 or not all(0 < value < bound for value in pair):
            raise ValueError(f"{key} = {list(pair)} must be 2 {kind}")
    if hub_diameter[0] >= hub_diameter[1]:
        raise ValueError(f"hub_diameter = {list(hub_diameter)} must ascend, bore before hub [m]")
    if blades != int(blades) or blades < 2:
        raise ValueError(f"blades = {blades} must be an integer of at least 2")
    if len(cells) != 5 or not all(n == int(n) and n >= 1 for n in cells):
        raise ValueError(f"cells = {list(cells)} must be 5 integers of at least 1")
    blades, (t, g, w, c, s) = int(blades), map(int, cells)
    refuse_mesh(blades * (c + 1) * ((t + g) * (w + 1) + (t + 1) * s), "mesh.cells")
    radii = [d / 2 for d in (*hub_diameter, diameter)]
    blade = _blade(radii, hub_length, blades, pitch_angle, chord, thickness, cells)
    hub = _hub(radii, hub_length, blades, pitch_angle[0], thickness[0], cells)
    try:
        mesh = check_mesh(_assemble(hub, blade, blades))
    except ValueError as error:
        raise ValueError(f"pitch_angle, chord or thickness fold the blades: {error}") from None
    bore = facets_in(Cylinder(0, radii[0]), mesh)
    rings = np.arange(mesh.nelements) < blades * np.prod(np.array(hub.shape[1:]) - [0, 1, 1])
    parts = {"hub": np.flatnonzero(rings), "blades": np.flatnonzero(~rings)}
    return mesh.with_boundaries({"bore": bore}).with_subdomains(parts)


def _hub(
    radii: Sequence[float],
    length: float,
    blades: int,
    pitch_angle: float,
    thickness: float,
    cells: Sequence[int],
) -> Points:
    """Return the points of the hub from one blade to the next, (3, around, wall, along)."""
    through, between, wall, along = map(int, cells[:4])
    foot = thickness / math.sin(math.radians(pitch_angle)) / radii[1]  # angle under a blade
    gap = np.linspace(foot / 2, 2 * math.pi / blades - foot / 2, between + 1)[1:-1]
    angle, radius, x = np.meshgrid(
        np.concatenate([np.linspace(-foot / 2, foot / 2, through + 1), gap]),
        np.linspace(radii[0], radii[1], wall + 1),
        np.linspace(-length / 2, length / 2, along + 1),
        indexing="ij",
    )
    return _from_cylindrical(x, radius, angle + x / math.tan(math.radians(pitch_angle)) / radii[1])


def _blade(
    radii: Sequence[float],
    hub_length: float,
    blades: int,
    pitch_angle: Sequence[float],
    chord: Sequence[float],
    thickness: Sequence[float],
    cells: Sequence[int],
) -> Points:
    """Return the points of the first blade without its root, (3, span, through, along)."""
    through, _, _, along, span = map(int, cells)
    across = (np.linspace(-0.5, 0.5, count + 1) for count in (through, along))
    rho, t, s = np.meshgrid(np.linspace(0, 1, span + 1), *across, indexing="ij")
    root, tip = np.tan(np.radians(pitch_angle))
    radius = radii[1] * (1 - rho) + radii[2] * rho
    beta = np.arctan((radii[1] * root * (1 - rho) + radii[2] * tip * rho) / radius)
    depth = thickness[0] * (1 - rho) + thickness[1] * rho
    if (depth / np.sin(beta) >= 0.99 * 2 * math.pi / blades * radius).any():
        raise ValueError(f"thickness = {list(thickness)} leaves no room between {blades} blades")
    width = hub_length * math.hypot(1, 1 / root) * (1 - rho) * (1 - 2 * rho)
    width += chord[0] * 4 * rho * (1 - rho) + chord[1] * rho * (2 * rho - 1)  # a parabola
    # At the hub a section is a parallelogram with its thickness along the circumference. Towards
    # the tip it becomes a lens with blunt edges and its thickness normal to the chord.
    start = np.clip(rho / 0.4, 0, 1)
    lens = start**2 * (3 - 2 * start)
    off = depth * t * (1 - 0.7 * lens * (2 * s) ** 2)
    on = width * s + off * (1 - lens) / np.tan(beta)
    arc = on * np.cos(beta) + off * np.sin(beta)
    return _from_cylindrical(on * np.sin(beta) - off * np.cos(beta), radius, arc / radius)[:, 1:]


def _from_cylindrical(x: Points, radius: Points, angle: Points) -> Points:
    """Return Cartesian points (3, ...) of cylindrical coordinates about the x axis."""
    return np.stack([x, radius * np.cos(angle), radius * np.sin(angle)])


def _assemble(hub: Points, blade: Points, blades: int) -> skfem.Mesh:
    """Return the mesh of all sectors of the hub and all blades, the cells of the hub first."""
    angles = 2 * math.pi / blades * np.arange(blades)
    points = np.concatenate(
        [_rotate(part, angle).reshape(3, -1) for part in (hub, blade) for angle in angles], axis=1
    )
    _, around, wall, along = hub.shape
    ring = np.arange(blades * hub[0].size).reshape(blades * around, wall, along)
    grids = [np.concatenate([ring, ring[:1]]).swapaxes(0, 1)]  # right-handed like the blades
    for b in range(blades):
        root = ring[b * around :][: blade.shape[2], -1]
        own = np.arange(blade[0].size).reshape(blade.shape[1:]) + ring.size + b * blade[0].size
        grids.append(np.concatenate([root[None], own]))
    t = np.concatenate([_hexahedra(grid) for grid in grids], axis=1)
    rows, columns = (t[list(c)].ravel() for c in zip(*np.ndindex(8, 8), strict=True))
    graph = coo_array((np.ones(len(rows)), (rows, columns))).tocsr()
    order = reduce_bandwidth(graph)
    return skfem.MeshHex(np.ascontiguousarray(points[:, order]), np.argsort(order)[t])


def _rotate(points: Points, angle: float) -> Points:
    c, s = math.cos(angle), math.sin(angle)
    return np.stack([points[0], c * points[1] - s * points[2], s * points[1] + c * points[2]])


def _hexahedra(grid: NDArray[np.int_]) -> NDArray[np.int_]:
    """Return the cells (8, E) of a grid of nodes (a, b, c)."""
    a, b, c = grid.shape
    corners = skfem.MeshHex.elem.refdom.p.T.astype(int)
    return np.stack(
        [grid[i : a - 1 + i, j : b - 1 + j, k : c - 1 + k].ravel() for i, j, k in corners]
    )

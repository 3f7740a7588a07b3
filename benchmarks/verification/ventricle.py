"""Truncated ellipsoid of the cardiac benchmark: mesh without a pole, and fibre directions.

The wall consists of the points x = r_s sin(u) cos(v), y = r_s sin(u) sin(v), z = r_l cos(u) with
r_s = 7 + 3 t and r_l = 17 + 3 t, t from 0 (endocardium) to 1 (epicardium), below the plane z = 5.
The apex has u = -pi. Lengths are in mm.

Source: Land et al. (2015), Proc. R. Soc. A 471:20150641, problems 2 and 3.
"""

from dataclasses import replace
from functools import reduce
from operator import add

import numpy as np
import skfem
from numpy.typing import NDArray

from benchmarks.verification.bodies import Array
from dpl.fem import box

SHORT, LONG, WALL, BASE = 7.0, 17.0, 3.0, 5.0  # endocardial half axes, thickness, z of the base
ON_SURFACE = 1e-6  # largest value of the equation of a surface at its nodes
DEPTH_ITER = 20  # Newton iterations for the depth of a point
CURVED = {skfem.MeshHex: skfem.MeshHex2, skfem.MeshTet: skfem.MeshTet2}
PATCH = 0.35  # half side of the square patch at the apex in the plane of parameters
EDGE, BULGE = 0.26, 0.12  # half side of this patch in the unit disc, and curvature of its sides


def ventricle(
    patch: int, rings: int, layers: int, *, quarter: bool = False, degree: int = 2,
    cell: str = "hexahedron",
) -> skfem.Mesh:  # fmt: skip
    """Return cells [mm] of the wall: a square patch at the apex and rings of cells around it.

    Args:
        patch: Cells along a half side of the patch; a quarter of a ring has 2 `patch` cells.
        rings: Rings of cells between patch and base.
        layers: Cells through the wall.
        quarter: Mesh x >= 0 and y >= 0 alone.
        degree: Degree of the geometry, 1 or 2.
        cell: "hexahedron", or for a quarter "tetra": six tetrahedra in each.
    """
    sides, start = (1, 0.0) if quarter else (2, -PATCH)
    counts = sides * patch + 1, layers + 1
    square = box([PATCH - start] * 2 + [1.0], [counts[0], *counts], cell)
    square = square.translated([start, start, 0.0])
    strip = box([1.0] * 3, [rings + 1, *counts], cell)
    distance = PATCH + (1 - PATCH) * strip.p[0]
    across, t = strip.p[1], strip.p[2]
    if quarter:
        along = across if cell == "tetra" else 1 - across  # tetrahedra share the diagonals of faces
        ring = [(distance, distance * across), (distance * along, distance)]
    else:
        x, y = distance, distance * (2 * across - 1)
        ring = [(x, y), (-y, x), (-x, -y), (y, -x)]
    parts = [type(strip)(np.stack([*sector, t]), strip.t) for sector in ring]
    mesh = reduce(add, parts, square)
    mesh = CURVED[type(mesh)].from_mesh(mesh) if degree == 2 else mesh
    return replace(mesh, doflocs=_placed(mesh.doflocs))


def fibres(points: Array, inner: float = 90.0, outer: float = -90.0) -> Array:
    """Return sin(a) dX/du + cos(a) dX/dv, divided by the lengths of these slopes, (n, 3) [-].

    Args:
        points: Points of the wall, (n, 3) [mm].
        inner, outer: Angle a on endocardium and epicardium [degrees], linear in t.
    """
    depth = depth_of(points)
    short, long, _ = _axes(depth)
    x, y, z = points.T
    angle, v = np.arctan2(np.hypot(x, y) / short, -z / long), np.arctan2(y, x)
    across_axis = short * np.cos(angle)
    along = np.stack([across_axis * np.cos(v), across_axis * np.sin(v), long * np.sin(angle)])
    along /= np.linalg.norm(along, axis=0)
    around = np.stack([-np.sin(v), np.cos(v), np.zeros_like(v)])
    a = np.radians(inner + (outer - inner) * depth)
    return np.asarray(np.sin(a) * along + np.cos(a) * around).T


def depth_of(points: Array) -> Array:
    """Return t of points of the wall, (n,) [-], by Newton's method from the middle."""
    radius, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    depth = np.full(len(points), 0.5)
    for _ in range(DEPTH_ITER):
        short, long, _ = _axes(depth)
        slope = -2 * WALL * (radius**2 / short**3 + z**2 / long**3)
        depth = depth - ((radius / short) ** 2 + (z / long) ** 2 - 1) / slope
    return depth


def endocardium(points: Array) -> NDArray[np.bool_]:
    """Return a mask of the nodes (N, 3) [mm] on the inner surface."""
    x, y, z = points.T
    return np.abs((x**2 + y**2) / SHORT**2 + z**2 / LONG**2 - 1) < ON_SURFACE


def apex(points: Array, depth: float) -> int:
    """Return the number of the node (N, 3) [mm] at the apex of the surface t = `depth`."""
    place = [0.0, 0.0, -LONG - WALL * depth]
    return int(np.linalg.norm(points - place, axis=1).argmin())


def _axes(depth: Array) -> tuple[Array, Array, Array]:
    """Return r_s [mm], r_l [mm] and the largest angle from the apex, u + pi [rad], at t."""
    short, long = SHORT + WALL * depth, LONG + WALL * depth
    return short, long, np.pi - np.arccos(BASE / long)


def _placed(parameters: Array) -> Array:
    """Return the points (3, N) [mm] of parameters (3, N)."""
    disc, depth = _disc(*parameters[:2]), parameters[2]
    short, long, steepest = _axes(depth)
    angle, v = np.hypot(*disc) * steepest, np.arctan2(disc[1], disc[0])  # u + pi and v - pi [rad]
    out = short * np.sin(angle)
    return np.stack([out * np.cos(v), out * np.sin(v), -long * np.cos(angle)])


def _disc(x: Array, y: Array) -> Array:
    """Return the points (2, N) of the unit disc for points of the square [-1, 1]^2.

    The patch max(|x|, |y|) <= PATCH becomes a square with curved sides; from these, straight lines
    lead to the circle.
    """
    size = np.maximum(np.abs(x), np.abs(y))
    outside = size > PATCH
    scale = np.where(outside, 1 / np.where(outside, size, 1.0), 1 / PATCH)
    a, b = x * scale, y * scale
    inner = EDGE * np.stack([a * (1 - BULGE * b**2), b * (1 - BULGE * a**2)])
    angle = np.where(np.abs(a) >= np.abs(b), np.pi / 4 * b / np.where(a, a, 1.0), 0.0)
    other = np.where(np.abs(a) < np.abs(b), np.pi / 4 * a / np.where(b, b, 1.0), 0.0)
    on_x = np.sign(a) * np.stack([np.cos(angle), np.sin(angle)])
    on_y = np.sign(b) * np.stack([np.sin(other), np.cos(other)])
    circle = np.where(np.abs(a) >= np.abs(b), on_x, on_y)
    share = np.where(outside, (size - PATCH) / (1 - PATCH), 0.0)
    return np.asarray((1 - share) * inner + share * circle)

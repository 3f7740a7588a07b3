"""The surface of a mesh, as triangles or lines."""

from typing import Any

import numpy as np
import skfem
from numpy.typing import NDArray


def surface(mesh: skfem.Mesh) -> NDArray[np.int_]:
    """Return the boundary facets of a mesh in 3D, its cells in 2D, as polygons (P, corners).

    The vertices of a polygon are in counterclockwise order seen from outside, in 2D from above.
    """
    points = mesh.p.T
    if mesh.dim() == 2:
        polygons = mesh.t.T.copy()
        (a, b), (c, d) = _sides(points, polygons)
        backwards = a * d < b * c
    else:
        facets = mesh.boundary_facets()
        polygons = mesh.facets[:, facets].T.copy()
        inside = points[mesh.t[:, mesh.f2t[0, facets]]].mean(axis=0)
        outwards = points[polygons].mean(axis=1) - inside
        first, second = (side.T for side in _sides(points, polygons))
        backwards = (np.cross(first, second) * outwards).sum(axis=1) < 0
    polygons[backwards] = polygons[backwards][:, ::-1]
    return polygons


def _sides(
    points: NDArray[np.float64], polygons: NDArray[np.int_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the vectors from the first corner of polygons to the next two, (D, P) each."""
    a, b, c = (points[polygons[:, k]] for k in range(3))
    return (b - a).T, (c - a).T


def coarse(points: NDArray[Any], polygons: NDArray[np.int_], most: int) -> NDArray[np.int_]:
    """Return at most `most` polygons (P, corners) that approximate the given ones.

    Vertex clustering: the points in each cell of a grid are replaced by one of them, and degenerate
    or duplicate polygons are removed. The grid is coarsened until the number is reached.

    Source: Rossignac, Borrel (1993), Multi-resolution 3D approximations for rendering complex
    scenes.

    Args:
        points: Vertices, (N, D).
        polygons: Indices of points, (P, corners).
        most: Maximum number of polygons, at least 1.
    """
    if len(polygons) <= most:
        return polygons
    used, flat = np.unique(polygons, return_inverse=True)
    places = points[used] - points[used].min(axis=0)
    cells, found = 2.0 * most**0.5, polygons
    while len(found) > most:
        lattice = np.floor(places / places.max() * cells).astype(np.int64)
        _, first, cluster = np.unique(lattice, axis=0, return_index=True, return_inverse=True)
        merged = used[first[cluster.reshape(-1)]][flat.reshape(polygons.shape)]
        ordered = np.sort(merged, axis=1)
        _, once = np.unique(ordered, axis=0, return_index=True)
        distinct = 1 + (np.diff(ordered[once], axis=1) > 0).sum(axis=1)
        found = merged[once[distinct > 2]]
        cells *= 0.85
    return found


def triangles(polygons: NDArray[np.int_]) -> NDArray[np.int_]:
    """Return a triangulation (T, 3) of polygons (P, corners) with the same orientation."""
    corners = polygons.shape[1]
    fans = [polygons[:, [0, k, k + 1]] for k in range(1, corners - 1)]
    flat = np.concatenate(fans)
    a, b, c = flat.T
    return flat[(a != b) & (b != c) & (c != a)]

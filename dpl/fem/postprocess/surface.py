"""The surface of a mesh, as polygons, triangles or lines."""

from typing import Any

import numpy as np
import skfem
from numpy.typing import NDArray

SMOOTH = 0.9  # smallest cosine between normals of facets that form a smooth surface


def surface(mesh: skfem.Mesh) -> NDArray[np.int_]:
    """Return the boundary facets of a mesh in 3D, its cells in 2D, as polygons (P, corners).

    The vertices of a polygon are in counterclockwise order seen from outside, in 2D from above.
    """
    points = np.pad(mesh.p.T, ((0, 0), (0, 3 - mesh.dim())))
    if mesh.dim() == 2:
        polygons, outwards = mesh.t.T.copy(), np.array([0.0, 0.0, 1.0])
    else:
        facets = mesh.boundary_facets()
        polygons = mesh.facets[:, facets].T.copy()
        inside = points[mesh.t[:, mesh.f2t[0, facets]]].mean(axis=0)
        outwards = points[polygons].mean(axis=1) - inside
    backwards = (triangle_normals(points, polygons[:, :3]) * outwards).sum(axis=1) < 0
    polygons[backwards] = polygons[backwards][:, ::-1]
    return polygons


def facet_edges(
    points: NDArray[Any], polygons: NDArray[np.int_]
) -> tuple[NDArray[np.int_], NDArray[np.bool_]]:
    """Return the edges, (K, 2), of polygons (P, corners) and a mask, (K,), of the feature edges.

    Feature edges are at the boundary or between polygons that do not form a smooth surface.
    """
    points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    normals = triangle_normals(points, polygons[:, :3])
    sides = np.stack([polygons, np.roll(polygons, -1, axis=1)], axis=-1).reshape(-1, 2)
    edges, index = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    polygon = np.repeat(np.arange(len(polygons)), polygons.shape[1])
    total = np.zeros((len(edges), 3))
    np.add.at(total, index.ravel(), normals[polygon])
    count = np.bincount(index.ravel(), minlength=len(edges))
    sharp = (total**2).sum(axis=1) < 2 + 2 * SMOOTH  # |n + m|^2 of two unit normals
    return edges, sharp | (count == 1)


def triangle_normals(points: NDArray[Any], triangles: NDArray[np.int_]) -> NDArray[Any]:
    """Return unit normals of triangles, (T, 3), of points (N, 3)."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def coarse(points: NDArray[Any], polygons: NDArray[np.int_], most: int) -> NDArray[np.int_]:
    """Return at most `most` polygons (P, corners) that approximate the given ones.

    Vertex clustering: the points in each cell of a grid are replaced by one of them, and degenerate
    or duplicate polygons are removed. The grid is coarsened until the number is reached.

    Source: Rossignac, Borrel (1993), Multi-resolution 3D approximations for rendering complex
    scenes.
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

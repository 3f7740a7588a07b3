"""The surface of a mesh, as triangles or lines."""

from typing import TYPE_CHECKING, Any

import numpy as np
import skfem
from numpy.typing import NDArray

if TYPE_CHECKING:
    pass


def surface(mesh: skfem.Mesh) -> NDArray[np.int_]:
    """Return what is seen of a mesh as polygons of vertices, (P, corners), in turn around each.

    In 3D the facets on the boundary, in 2D the cells; anticlockwise seen from outside, in 2D from
    above.
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
    """Return vectors from the first corner of polygons to the next two, (D, P) each."""
    a, b, c = (points[polygons[:, k]] for k in range(3))
    return (b - a).T, (c - a).T


def coarse(points: NDArray[Any], polygons: NDArray[np.int_], most: int) -> NDArray[np.int_]:
    """Return no more than so many polygons (P, corners) on some of the same points.

    Points in one cell of a grid become one of them; polygons that fall together go. The grid is
    made coarser until they are few enough.

    Source: Rossignac, Borrel (1993), Multi-resolution 3D approximations for rendering complex
    scenes, for clusters of vertices.

    Args:
        points: (N, D).
        polygons: Of indices of points.
        most: 1 or more.
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
    """Return polygons (P, corners) as triangles, (T, 3), which turn as they do."""
    corners = polygons.shape[1]
    fans = [polygons[:, [0, k, k + 1]] for k in range(1, corners - 1)]
    flat = np.concatenate(fans)
    a, b, c = flat.T
    return flat[(a != b) & (b != c) & (c != a)]

"""Surface of a body, its division into colour bands, and symbols of its supports."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem import Problem, surface
from dpl.fem.assembly.recovery import Recovery
from dpl.fem.postprocess import cauchy, facet_edges, triangle_normals, von_mises
from dpl.fem.postprocess import triangles as triangulate

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
THICKNESS = 0.03  # of slabs over L [-]
PYRAMID = 0.035, 0.014  # height and half width of pyramids over L [-]


@dataclass(frozen=True, eq=False)
class Surface:
    """Surface of a body; in 2D the body itself. Cells of degree 2 are drawn by their corners.

    Attributes:
        problem: The body.
        nodes: Nodes on the surface, (S,).
        triangles: Triangles as indices into `nodes`, anticlockwise seen from outside, (T, 3).
        edges: Edges of facets as indices into `nodes`, (K, 2).
        feature_edges: Edges at the boundary or between facets that are not smooth, (R, 2).
    """

    problem: Problem
    nodes: Ints
    triangles: Ints
    edges: Ints
    feature_edges: Ints

    @classmethod
    def of(cls, problem: Problem) -> "Surface":
        """Return the surface of a body."""
        points = _to_3d(problem.points.numpy())
        facets = surface(problem.mesh)
        edges, features = facet_edges(points, facets)
        nodes = np.unique(facets)
        number = np.full(len(points), -1)
        number[nodes] = np.arange(len(nodes))
        edges = number[edges]
        return cls(problem, nodes, number[triangulate(facets)], edges, edges[features])

    @cached_property
    def undeformed(self) -> Floats:
        """Undeformed positions of the nodes over L, (S, 3) [-]."""
        return _to_3d(self.problem.points.numpy())[self.nodes]

    @cached_property
    def supports(self) -> "SupportSymbols":
        """Symbols of the supports."""
        return SupportSymbols.of(self)

    @cached_property
    def planar(self) -> bool:
        """True for a body in 2D."""
        return self.problem.shape[1] == 2

    @cached_property
    def _patches(self) -> tuple[Problem, Recovery]:
        """The cells that determine the stresses at the surface, and their recovery."""
        body = self.problem
        cells, recovery = body.recovery.restricted_to(self.nodes)
        chosen = torch.from_numpy(cells)
        if body.discretisation.equal_cells:
            return replace(body, cells=body.cells[chosen]), recovery
        parts = {name: getattr(body, name)[chosen] for name in ("cells", "dN", "dV")}
        return replace(body, **parts), recovery

    def deformed_points(self, displacement: Tensor) -> Floats:
        """Return the deformed positions over L, (S, 3) [-], of displacements (N, D) [-]."""
        return self.undeformed + _to_3d(displacement.numpy()[self.nodes])

    def von_mises(self, displacement: Tensor, parameters: Tensor) -> Floats:
        """Return the von Mises stress over E at the nodes of the surface, (S,) [-].

        Args:
            displacement: Displacement over L, (N, D) [-].
            parameters: Parameters as in a load, (1, P).
        """
        body, (cells, recovery) = self.problem.with_parameters(parameters), self._patches
        if body is not self.problem:
            cells = replace(cells, material=body.material)
        return von_mises(recovery(cauchy(cells, displacement[None])))[0].numpy()

    def middle_node(self, mask: NDArray[np.bool_]) -> int:
        """Return the node of the body in the middle of the marked nodes (S,) of the surface.

        It is one of the marked nodes; the one in the middle of all if none is marked.
        """
        chosen = np.flatnonzero(mask) if mask.any() else np.arange(len(mask))
        points = self.undeformed[chosen]
        return int(self.nodes[chosen[((points - points.mean(axis=0)) ** 2).sum(axis=1).argmin()]])

    def nearest_node(self, points: Floats, position: Floats) -> int:
        """Return the node of the body whose position (S, 3) is nearest to a point (3,)."""
        return int(self.nodes[np.argmin(((points - position) ** 2).sum(axis=1))])


def contour_bands(points: Floats, triangles: Ints, levels: Floats, count: int) -> list[Floats]:
    """Return the parts of a surface with levels from k to k + 1, for K = `count` bands.

    Levels at the points, (S,), are interpolated linearly in triangles (T, 3) of points (S, 3). The
    result are the corners of the triangles of each band: K arrays of shape (3 n_k, 3).
    """
    levels = np.clip(levels, 0.0, count * (1 - 1e-9))
    order = np.argsort(levels[triangles], axis=1, kind="stable")
    flip = order[:, 1] == (order[:, 0] + 2) % 3  # sorting reversed the orientation
    corners = np.take_along_axis(triangles, order, axis=1)
    lowest, highest = levels[corners[:, [0, 2]]].astype(int).T
    repeats = highest - lowest + 1
    owner = np.repeat(np.arange(len(triangles)), repeats)
    band = lowest[owner] + np.arange(len(owner)) - (np.cumsum(repeats) - repeats)[owner]
    p0, p1, p2 = (points[corners[owner, k]] for k in range(3))
    v0, v1, v2 = (levels[corners[owner, k]] for k in range(3))

    def on_short_sides(level: Floats) -> Floats:
        before = ((level <= v1) & (v0 < v1))[:, None]
        below, above = (p0, p1, v0, v1, level), (p1, p2, v1, v2, level)
        return np.where(before, _interpolate(*below), _interpolate(*above))

    low, high = np.maximum(band, v0), np.minimum(band + 1, v2)
    a, b = _interpolate(p0, p2, v0, v2, low), _interpolate(p0, p2, v0, v2, high)
    b = np.where((v0 == v2)[:, None], p2, b)  # the whole triangle is in one band
    c, e = on_short_sides(high), on_short_sides(low)
    kink = (low < v1) & (v1 < high)  # p1 is a corner between c and e
    d = np.where(kink[:, None], p1, e)
    soup = np.concatenate([  # a fan around a
        np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1), np.stack([a, e, d], axis=1)[kink]
    ])  # fmt: skip
    source = np.concatenate([np.arange(len(a)), np.arange(len(a)), np.flatnonzero(kink)])
    flipped, band = flip[owner[source]], band[source]
    soup[flipped] = soup[flipped][:, [0, 2, 1]]
    sides = soup - np.roll(soup, 1, axis=1)
    proper = (sides != 0).any(axis=2).all(axis=1)  # a contour can pass a corner
    soup, band = soup[proper], band[proper]
    order = np.argsort(band, kind="stable")
    starts = np.searchsorted(band[order], np.arange(1, count))
    return [part.reshape(-1, 3) for part in np.split(soup[order], starts)]


def _interpolate(p: Floats, q: Floats, v: Floats, w: Floats, level: Floats) -> Floats:
    """Return the points of segments pq, with values v at p and w at q, at a level."""
    share = np.divide(level - v, w - v, out=np.zeros_like(v), where=w > v)
    return p + np.clip(share, 0.0, 1.0)[:, None] * (q - p)


def exit_distance(points: Floats, triangles: Ints, origin: Floats, direction: Floats) -> float:
    """Return the distance at which a ray first leaves a surface; 0 if it does not.

    Möller, Trumbore (1997), Fast, minimum storage ray-triangle intersection.
    """
    a, b, c = (points[triangles[:, k]] for k in range(3))
    first, last = b - a, c - a
    normal = np.cross(first, last)
    slope = normal @ direction
    scale = np.where(slope > 1e-12, slope, np.inf)  # only triangles that the ray leaves through
    distance = ((a - origin) * normal).sum(axis=1) / scale
    hit = origin + distance[:, None] * direction - a
    across = np.linalg.norm(normal, axis=1) ** 2
    u = (np.cross(hit, last) * normal).sum(axis=1) / np.maximum(across, 1e-300)
    v = (np.cross(first, hit) * normal).sum(axis=1) / np.maximum(across, 1e-300)
    inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (slope > 1e-12)
    found = distance[inside & (distance > 0)]
    return float(found.min()) if len(found) else 0.0


def vertex_normals(points: Floats, triangles: Ints) -> Floats:
    """Return the normalised sums of the triangle normals at each point, (S, 3)."""
    normals = triangle_normals(points, triangles)
    total = np.zeros_like(points)
    for k in range(3):
        np.add.at(total, triangles[:, k], normals)
    return _normalise(total)


def _normalise(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def _to_3d(vectors: Floats) -> Floats:
    """Return vectors (n, D) padded with zeros to (n, 3)."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))


@dataclass(frozen=True, eq=False)
class SupportSymbols:
    """Mesh of the symbols of supports, whose vertices follow nodes of the surface.

    A slab lies behind fixed facets, a pyramid at each other fixed node. A node is fixed if at least
    one component of its displacement is prescribed.

    Attributes:
        nodes: Node of the surface that each vertex follows, (V,).
        offsets: Distance of each vertex from its node over L, (V, 3) [-].
        triangles: Indices of vertices, (T, 3).
        moves: True if a fixed node can move, on a sliding or moved support.
    """

    nodes: Ints
    offsets: Floats
    triangles: Ints
    moves: bool

    @classmethod
    def of(cls, surface: Surface) -> "SupportSymbols":
        """Return the symbols of a body; there are none if no node of the surface is fixed."""
        problem = surface.problem
        fixed = ~problem.free[torch.from_numpy(surface.nodes)]
        is_fixed = fixed.any(dim=1).numpy()
        moves = bool((fixed.any(dim=1) & ~fixed.all(dim=1)).any() or problem.prescribed.any())
        slabs = _strips(surface, is_fixed) if surface.planar else _slabs(surface, is_fixed)
        single = is_fixed.copy()
        single[slabs[0]] = False
        pyramids = _pyramids(surface, np.flatnonzero(single))
        nodes, offsets = (np.concatenate([slabs[k], pyramids[k]]) for k in (0, 1))
        triangles = np.concatenate([slabs[2], pyramids[2] + len(slabs[0])])
        return cls(nodes, offsets, triangles, moves)

    def vertices(self, points: Floats) -> Floats:
        """Return the vertices (V, 3) at positions (S, 3) of the surface."""
        return np.asarray(points[self.nodes] + self.offsets)


def _slabs(surface: Surface, is_fixed: NDArray[np.bool_]) -> tuple[Ints, Floats, Ints]:
    """Return nodes, offsets and triangles of slabs on the triangles whose corners are fixed."""
    triangles = surface.triangles[is_fixed[surface.triangles].all(axis=1)]
    normals = vertex_normals(surface.undeformed, triangles)
    return _extrude(triangles, _rim(triangles), THICKNESS * normals)


def _strips(surface: Surface, is_fixed: NDArray[np.bool_]) -> tuple[Ints, Floats, Ints]:
    """Return nodes, offsets and triangles of strips along the fixed boundary of a body in 2D."""
    sides = _rim(surface.triangles)
    sides = sides[is_fixed[sides].all(axis=1)]
    first, last = surface.undeformed[sides.T]
    total = np.zeros_like(surface.undeformed)
    for k in (0, 1):
        np.add.at(total, sides[:, k], np.cross(last - first, (0.0, 0.0, 1.0)))
    return _extrude(np.zeros((0, 3), dtype=int), sides, THICKNESS * _normalise(total))


def _rim(triangles: Ints) -> Ints:
    """Return the sides (K, 2) that belong to one triangle only, in its orientation."""
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, index, count = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return np.asarray(sides[count[index.ravel()] == 1])


def _extrude(triangles: Ints, sides: Ints, offsets: Floats) -> tuple[Ints, Floats, Ints]:
    """Return nodes, offsets and triangles of shifted triangles and of the walls below `sides`."""
    used = np.unique(np.concatenate([triangles.ravel(), sides.ravel()]))
    number = np.zeros(len(offsets), dtype=int)
    number[used] = np.arange(len(used))
    a, b = number[sides].T
    c, d = a + len(used), b + len(used)
    walls = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    shifts = np.concatenate([np.zeros((len(used), 3)), offsets[used]])
    outer = number[triangles] + len(used)
    return np.tile(used, 2), shifts, np.concatenate([outer, walls])


def _pyramids(surface: Surface, single: Ints) -> tuple[Ints, Floats, Ints]:
    """Return nodes, offsets and triangles of pyramids with their tips at single fixed nodes."""
    height, half = PYRAMID
    axis = np.zeros((len(single), 3))
    if surface.planar:
        axis[:, 1] = -1.0
    else:
        axis[:] = vertex_normals(surface.undeformed, surface.triangles)[single]
    other = np.eye(3)[np.abs(axis).argmin(axis=1)]
    first = _normalise(np.cross(axis, other))
    second = np.cross(axis, first)
    base = [
        height * axis + half * (i * first + j * second)
        for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ]
    offsets = np.stack([0 * axis, *base], axis=1).reshape(-1, 3)
    faces = np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]])
    triangles = (5 * np.arange(len(single))[:, None, None] + faces).reshape(-1, 3)
    return np.repeat(single, 5), offsets, triangles

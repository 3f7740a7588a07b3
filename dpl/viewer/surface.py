"""Surface of a body, its division into colour bands, and symbols of its supports."""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

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
MARK, MAX_MARKS = 0.014, 120  # half size over L [-] and number of the symbols of supports


@dataclass(frozen=True, eq=False)
class Surface:
    """Surface of a body; in 2D the body itself. Cells of degree 2 are drawn by their corners."""

    problem: Problem
    nodes: Ints  # on the surface, (S,)
    triangles: Ints  # indices into `nodes`, anticlockwise seen from outside, (T, 3)
    edges: Ints  # of facets, indices into `nodes`, (K, 2)
    feature_edges: Ints  # at the boundary or between facets that are not smooth, (R, 2)

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

    def supports(self, points: Floats) -> Floats:
        """Return the corners (8 n, 3, 3) of octahedra at the fixed nodes of a surface (S, 3)."""
        fixed = np.flatnonzero(~self.problem.free.numpy()[self.nodes].all(axis=1))
        fixed = fixed[:: len(fixed) // MAX_MARKS + 1]
        x, y, z = MARK * np.eye(3)
        signs = product((1, -1), repeat=3)  # of an octant, whose face has its normal outside
        corners = [(i * x, j * y, k * z)[:: i * j * k] for i, j, k in signs]
        return (points[fixed, None, None] + corners).reshape(-1, 3, 3)

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

        The displacement (N, D) is over L; `parameters` are those of a load, (1, P).
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
    vertices = np.column_stack([points, np.clip(levels, 0.0, count)])
    rest, bands = vertices[triangles], []
    for level in range(1, count):
        below, rest = _cut(rest, level)
        bands.append(below[..., :3].reshape(-1, 3))
    return [*bands, rest[..., :3].reshape(-1, 3)]


def _cut(soup: Floats, level: float) -> tuple[Floats, Floats]:
    """Return the parts of triangles (n, 3, 4), points and levels, below and above a level."""
    above = soup[..., 3] >= level
    number = above.sum(axis=1)
    crossed = (number == 1) | (number == 2)
    cut, has_lone_above = soup[crossed], number[crossed] == 1
    lone = (above[crossed] == has_lone_above[:, None]).argmax(axis=1)  # on a side of its own
    turned = (lone[:, None] + np.arange(3)) % 3  # keeps the orientation
    a, b, c = np.take_along_axis(cut, turned[..., None], axis=1).swapaxes(0, 1)
    p, q = (a + ((level - a[:, 3:]) / (end[:, 3:] - a[:, 3:])) * (end - a) for end in (b, c))
    p[:, 3] = q[:, 3] = level
    tips = np.stack([a, p, q], axis=1)
    bases = np.stack([p, b, c, p, c, q], axis=1).reshape(-1, 2, 3, 4)
    below, over = (
        np.concatenate([soup[number == kept], tips[chosen], bases[~chosen].reshape(-1, 3, 4)])
        for kept, chosen in ((0, ~has_lone_above), (3, has_lone_above))
    )
    return below, over


def exit_distance(points: Floats, triangles: Ints, origin: Floats, direction: Floats) -> float:
    """Return the distance at which a ray first leaves a surface; 0 if it does not.

    Möller, Trumbore (1997), Fast, minimum storage ray-triangle intersection.
    """
    a, b, c = points[triangles].swapaxes(0, 1)
    axes = np.stack([b - a, c - a, np.broadcast_to(-direction, a.shape)], axis=-1)
    leaves = np.linalg.det(axes) < -1e-12  # the ray leaves through these triangles
    right = (origin - a)[leaves, :, None]
    u, v, distance = np.linalg.solve(axes[leaves], right)[..., 0].T
    hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (distance > 0)
    return float(distance[hit].min()) if hit.any() else 0.0


def vertex_normals(points: Floats, triangles: Ints) -> Floats:
    """Return the normalised sums of the triangle normals at each point, (S, 3)."""
    normals = triangle_normals(points, triangles)
    total = np.zeros_like(points)
    for k in range(3):
        np.add.at(total, triangles[:, k], normals)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)


def _to_3d(vectors: Floats) -> Floats:
    """Return vectors (n, D) padded with zeros to (n, 3)."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))

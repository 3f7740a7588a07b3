"""What is seen of a body: its surface, cut into bands of one colour."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem import Problem, fields, surface
from dpl.fem.postprocess import triangles as fans

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
SHARP = 0.9  # cosine between normals below which an edge is one of the shape


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface of a body; in 2D the body itself. Cells of degree 2 are drawn by their corners.

    Attributes:
        problem: The body.
        nodes: Its nodes that are drawn, (S,).
        triangles: Of those, in their order here, seen from outside anticlockwise, (T, 3).
        lines: Edges of facets, (K, 2).
        rims: Those where the surface bends sharply or ends, (R, 2).
    """

    problem: Problem
    nodes: Ints
    triangles: Ints
    lines: Ints
    rims: Ints

    @classmethod
    def of(cls, problem: Problem) -> "Surface":
        """Return the surface of a body."""
        rest = _in_space(problem.points.numpy())
        facets = surface(problem.mesh)
        corners = facets.shape[1]
        normals = _normals(rest, facets[:, :3])
        sides = np.stack([facets, np.roll(facets, -1, axis=1)], axis=-1).reshape(-1, 2)
        lines, where = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
        owner = np.repeat(np.arange(len(facets)), corners)
        total = np.zeros((len(lines), 3))
        np.add.at(total, where.ravel(), normals[owner])
        count = np.bincount(where.ravel(), minlength=len(lines))
        bent = (total**2).sum(axis=1) < 2 + 2 * SHARP  # |n + m|^2 of two unit normals
        nodes = np.unique(facets)
        number = np.full(len(rest), -1)
        number[nodes] = np.arange(len(nodes))
        triangles = number[fans(facets)]
        return cls(problem, nodes, triangles, number[lines], number[lines[bent | (count == 1)]])

    @cached_property
    def rest(self) -> Floats:
        """Nodes of the surface without load, (S, 3) [-]."""
        return _in_space(self.problem.points.numpy())[self.nodes]

    @cached_property
    def shell(self) -> Problem:
        """The cells at the surface: all that stresses at its nodes depend on."""
        body = self.problem
        drawn = torch.zeros(body.shape[0], dtype=torch.bool)
        drawn[self.nodes] = True
        kept = drawn[body.cells].any(dim=1)
        cells = body.cells[kept]
        if body.equal_cells:
            return replace(body, cells=cells)
        return replace(body, cells=cells, dN=body.dN[kept], dV=body.dV[kept])

    def moved(self, displacement: Tensor) -> Floats:
        """Return the nodes of the surface where displacements (N, D) [-] take them, (S, 3) [-]."""
        return self.rest + _in_space(displacement.numpy()[self.nodes])

    def von_mises(self, displacement: Tensor, poisson: Tensor) -> Floats:
        """Return von Mises stress over E at the surface under displacements (N, D) [-], (S,) [-].

        Args:
            displacement: Over L.
            poisson: As that of a load, (1, P).
        """
        body = self.problem.at(poisson)
        shell = self.shell if body is self.problem else replace(self.shell, material=body.material)
        found = fields(shell, displacement[None]).von_mises[0]
        return found.numpy()[self.nodes]

    def nearest(self, points: Floats, place: Floats) -> int:
        """Return the node of the body whose place (S, 3) is nearest to a point (3,)."""
        return int(self.nodes[np.argmin(((points - place) ** 2).sum(axis=1))])


def bands(points: Floats, triangles: Ints, levels: Floats, count: int) -> list[Floats]:
    """Return a triangulated surface cut into bands, for each the corners of its triangles.

    Args:
        points: (S, 3).
        triangles: (T, 3).
        levels: At points, (S,): band k is where they lie between k and k + 1.
        count: Bands, K.

    Returns:
        K arrays, (3 times its triangles, 3).
    """
    levels = np.clip(levels, 0.0, count * (1 - 1e-9))
    order = np.argsort(levels[triangles], axis=1, kind="stable")
    odd = order[:, 1] == (order[:, 0] + 2) % 3
    sorted_ = np.take_along_axis(triangles, order, axis=1)
    lowest, highest = levels[sorted_[:, 0]].astype(int), levels[sorted_[:, 2]].astype(int)
    owner = np.repeat(np.arange(len(triangles)), highest - lowest + 1)
    first = np.cumsum(highest - lowest + 1) - (highest - lowest + 1)
    band = lowest[owner] + np.arange(len(owner)) - first[owner]
    p0, p1, p2 = (points[sorted_[owner, k]] for k in range(3))
    v0, v1, v2 = (levels[sorted_[owner, k]] for k in range(3))
    low, high = np.maximum(band, v0), np.minimum(band + 1, v2)

    def long_side(level: Floats) -> Floats:
        return _between(p0, p2, v0, v2, level)

    def short_sides(level: Floats) -> Floats:
        below = ((level <= v1) & (v0 < v1))[:, None]
        return np.where(below, _between(p0, p1, v0, v1, level), _between(p1, p2, v1, v2, level))

    a, b, c, e = long_side(low), long_side(high), short_sides(high), short_sides(low)
    flat = (v0 == v2)[:, None]  # all of it in one band
    b, c, e = np.where(flat, p2, b), np.where(flat, p1, c), np.where(flat, p0, e)
    kink = (low < v1) & (v1 < high)
    d = np.where(kink[:, None], p1, e)
    # the cut-out polygon a, b, c, d, e as a fan; where there is no kink, d is e
    turned = odd[owner]
    pieces = [(a, c, b), (a, d, c), (a[kink], e[kink], d[kink])]
    ways, belongs = [turned, turned, turned[kink]], [band, band, band[kink]]
    soup = np.stack([np.concatenate(column) for column in zip(*pieces, strict=True)], axis=1)
    back, whose = np.concatenate(ways), np.concatenate(belongs)
    soup[back] = soup[back][:, [0, 2, 1]]
    kept = np.ones(len(soup), dtype=bool)
    for i, j in ((0, 1), (1, 2), (0, 2)):  # where a cut goes through a corner
        kept &= (soup[:, i] != soup[:, j]).any(axis=1)
    soup, whose = soup[kept], whose[kept]
    ranked = np.argsort(whose, kind="stable")
    cuts = np.searchsorted(whose[ranked], np.arange(1, count))
    return [part.reshape(-1, 3) for part in np.split(soup[ranked], cuts)]


def _between(p: Floats, q: Floats, v: Floats, w: Floats, level: Floats) -> Floats:
    """Return the points of segments pq, of values v to w, at a level."""
    share = np.divide(level - v, w - v, out=np.zeros_like(v), where=w > v)
    return p + np.clip(share, 0.0, 1.0)[:, None] * (q - p)


def _normals(points: Floats, triangles: Ints) -> Floats:
    """Return unit normals of triangles, (T, 3)."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def _in_space(vectors: Floats) -> Floats:
    """Return vectors (n, D) as (n, 3)."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))

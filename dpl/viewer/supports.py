"""Symbols of the supports: a slab behind fixed facets and a pyramid at single fixed nodes."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from dpl.viewer.surface import Floats, Ints, Surface, vertex_normals

THICKNESS = 0.03  # of slabs over L [-]
PYRAMID = 0.035, 0.014  # height and half width of pyramids over L [-]
SUPPORT_COLOUR = (71, 85, 105)


@dataclass(frozen=True, eq=False)
class SupportSymbols:
    """Mesh of the symbols; its vertices follow nodes of the surface.

    A node is fixed if at least one component of its displacement is prescribed.

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
        slabs = _strips(surface, is_fixed) if problem.shape[1] == 2 else _slabs(surface, is_fixed)
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
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, index, count = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return _extrude(triangles, sides[count[index.ravel()] == 1], THICKNESS * normals)


def _strips(surface: Surface, is_fixed: NDArray[np.bool_]) -> tuple[Ints, Floats, Ints]:
    """Return nodes, offsets and triangles of strips along the fixed boundary of a body in 2D."""
    sides = surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, index, count = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    sides = sides[(count[index.ravel()] == 1) & is_fixed[sides].all(axis=1)]
    first, last = (surface.undeformed[sides[:, k]] for k in (0, 1))
    outwards = np.cross(last - first, (0.0, 0.0, 1.0))
    total = np.zeros_like(surface.undeformed)
    for k in (0, 1):
        np.add.at(total, sides[:, k], outwards)
    size = np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    return _extrude(np.zeros((0, 3), dtype=int), sides, THICKNESS * total / size)


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
    if surface.problem.shape[1] == 2:
        axis[:, 1] = -1.0
    else:
        axis[:] = vertex_normals(surface.undeformed, surface.triangles)[single]
    other = np.eye(3)[np.abs(axis).argmin(axis=1)]
    first = np.cross(axis, other)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)
    second = np.cross(axis, first)
    base = [
        height * axis + half * (i * first + j * second)
        for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ]
    offsets = np.stack([0 * axis, *base], axis=1).reshape(-1, 3)
    faces = np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]])
    triangles = (5 * np.arange(len(single))[:, None, None] + faces).reshape(-1, 3)
    return np.repeat(single, 5), offsets, triangles

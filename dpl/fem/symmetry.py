"""Symmetries of a body: motions that turn exact solutions into exact solutions of other loads."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from dpl.fem.problem import Problem

Array = NDArray[np.float64]

NEAR = 1e-7  # over L: points as close as this are one
SAME = 1e-11  # of the largest value: fields that differ by less are the same. In the residual of an
# image, whose forces nearly cancel, the difference weighs a hundred times as much.


class Symmetry(NamedTuple):
    """A motion that maps a body onto itself.

    It takes node `source[i]` to node i and turns vectors by Q. If u balances the force f,
    `image(u)` balances `image(f)`.

    Attributes:
        rotation: Q, orthogonal, (D, D) [-]; a reflection where det Q = -1.
        source: Node whose value each node takes, (N,) int64.
    """

    rotation: Tensor
    source: Tensor

    def image(self, field: Tensor) -> Tensor:
        """Return the image (..., N, D) of a nodal field (..., N, D)."""
        return field[..., self.source, :] @ self.rotation.mT.to(field)


def images(field: Tensor, group: Sequence[Symmetry], which: Tensor) -> Tensor:
    """Return nodal fields (B, N, D), each as its image under one member of a group.

    Args:
        field: (B, N, D).
        group: Symmetries, the identity first.
        which: Place of the member for each field, (B,).
    """
    image = field.clone()
    for k, symmetry in enumerate(group[1:], 1):
        mine = which == k
        if mine.any():
            image[mine] = symmetry.image(field[mine])
    return image


def products(group: Sequence[Symmetry]) -> Tensor:
    """Return which member image j of image i is, (G, G) int64; (1, 1) for an empty group."""
    if not group:
        return torch.zeros(1, 1, dtype=torch.int64)
    Q = torch.stack([symmetry.rotation for symmetry in group]).cpu()
    every = Q[None] @ Q[:, None]  # first i, then j
    return (every[:, :, None] - Q).flatten(3).norm(dim=3).argmin(dim=2)


def symmetries(problem: Problem, *, also: Sequence[Tensor] = ()) -> list[Symmetry]:
    """Return the group of a body's symmetries, the identity first, always in the same order.

    A symmetry takes nodes to nodes, the supports to the supports, and commutes with the internal
    force, so that mesh, law and springs share it. All this is tested, by the nodes themselves and
    on two fixed displacements; nothing is taken from the name or the shape of a body.

    Args:
        problem: The body. One with two nodes in one place has the identity alone.
        also: Nodal fields (N, D) that a symmetry must leave as they are, such as the force that
            every load holds.
    """
    points = problem.points.cpu().numpy()
    points = points - points.mean(axis=0)  # which every symmetry takes to itself
    fixed = [problem.prescribed, *also]
    operators, fields = _operators(problem), _fields(problem, points)
    results = [operator(fields) for operator in operators]

    def holds(symmetry: Symmetry) -> bool:
        return all(_same(symmetry.image(field), field) for field in fixed) and all(
            _same(operator(symmetry.image(fields)), symmetry.image(result))
            for operator, result in zip(operators, results, strict=True)
        )

    motions = _motions(points, np.count_nonzero(problem.free.cpu().numpy(), axis=1))
    found = [s for s in (Symmetry(*(a.to(fields.device) for a in m)) for m in motions) if holds(s)]
    if not found:
        one = torch.eye(points.shape[1], dtype=torch.float64), torch.arange(len(points))
        return [Symmetry(*(part.to(fields.device) for part in one))]
    return sorted(_closed(found), key=lambda symmetry: symmetry.source.tolist())


def _operators(problem: Problem) -> list[Callable[[Tensor], Tensor]]:
    """Return what must commute with a symmetry: supports, cells, springs, each on its own scale."""
    springs, body = problem.springs, problem.reference  # isotropic: every Poisson's ratio alike
    cells = body if springs is None else replace(body, springs=None)
    operators: list[Callable[[Tensor], Tensor]] = [
        lambda field: torch.where(problem.free, field, 0.0),
        lambda field: cells.evaluate(field).internal,
    ]
    return operators if springs is None else [*operators, springs.force]


def _fields(problem: Problem, points: Array) -> Tensor:
    """Return two displacements without any symmetry, waves and noise, (2, N, D) [-].

    They are so small that |H| < 1/2 in them and in all their images: none inverts a cell, which
    some laws do not survive.
    """
    rng, dim = np.random.default_rng(0), points.shape[1]
    waves = np.sin(4 * points @ rng.standard_normal((dim, dim)) + rng.uniform(0, 6, dim))
    fields = torch.from_numpy(np.stack([waves, rng.uniform(-1, 1, points.shape)]))
    fields = fields.to(problem.points.device)
    steepest = problem.dN.norm(dim=-1).sum(dim=-1).max()
    return fields / (2 * steepest * fields.norm(dim=-1).amax(dim=-1))[:, None, None]


def _same(found: Tensor, expected: Tensor) -> bool:
    """Return whether fields (..., N, D) are equal but for rounding; those with NaN are not."""
    error, size = ((x.abs().amax(dim=(-2, -1))) for x in (found - expected, expected))
    return bool((error <= SAME * size).all())


def _motions(points: Array, marks: NDArray[np.int_]) -> list[tuple[Tensor, Tensor]]:
    """Return all motions about the origin, as in `Symmetry`, that take nodes to nodes.

    Args:
        points: Nodes, (N, D) [-].
        marks: What a node has in common with its image, (N,).
    """
    distance = _classes(np.linalg.norm(points, axis=1))
    kinds = np.unique(np.stack([distance, marks]), axis=1, return_inverse=True)[1].ravel()
    tree, candidates = KDTree(points), _candidates(points, kinds)
    probes = points[:: 1 + len(points) // 16] @ candidates.mT  # (C, 16, D), quickly looked up
    candidates = candidates[np.isfinite(tree.query(probes, distance_upper_bound=NEAR)[0]).all(1)]
    motions = []
    for Q in candidates:
        # the node at Q^-1 x_i is the one that Q takes to x_i
        gap, source = tree.query(points @ Q, distance_upper_bound=NEAR)
        if np.isfinite(gap).all() and len(np.unique(source)) == len(source):
            motions.append((torch.from_numpy(_fitted(points, source)), torch.from_numpy(source)))
    return motions


def _classes(values: Array) -> NDArray[np.int_]:
    """Return the number of the run of near values that each is in, (N,)."""
    order = np.argsort(values)
    classes = np.empty(len(values), dtype=np.int64)
    classes[order] = np.cumsum(np.diff(values[order], prepend=values.min()) > NEAR)
    return classes


def _candidates(points: Array, kinds: NDArray[np.int_]) -> Array:
    """Return orthogonal maps (C, D, D), all symmetries of the nodes among them.

    The place of D - 1 nodes that are not in line with the origin leaves two maps, mirror images of
    one another. So nodes of the rarest kinds are taken to all others of their kinds.
    """
    sizes = np.bincount(kinds)[kinds]

    def rarest(reach: Array) -> int:
        return int(np.where(reach >= reach.max() / 2, sizes, np.inf).argmin())

    first = rarest(np.linalg.norm(points, axis=1))
    images = np.flatnonzero(kinds == kinds[first])
    if points.shape[1] == 2:
        frame, frames = points[[first]], points[images, None]
    else:
        second = rarest(np.linalg.norm(np.cross(points, points[first]), axis=1))
        others = np.flatnonzero(kinds == kinds[second])
        frame = points[[first, second]]
        gaps = cdist(points[images], points[others]) - np.linalg.norm(frame[0] - frame[1])
        i, j = np.nonzero(np.abs(gaps) < 2 * NEAR)
        frames = np.stack([points[images[i]], points[others[j]]], axis=1)
    right = np.linalg.inv(_completed(frame)) @ _completed(frames)
    left = np.linalg.inv(_completed(frame)) @ _completed(frames, -1.0)
    return np.concatenate([right, left]).mT


def _completed(vectors: Array, sense: float = 1.0) -> Array:
    """Return D - 1 vectors (..., D - 1, D) and one across them, (..., D, D)."""
    if vectors.shape[-1] == 2:
        across = vectors[..., ::-1] * [-1.0, 1.0]
    else:
        across = np.cross(vectors[..., :1, :], vectors[..., 1:, :])
    return np.concatenate([vectors, sense * across], axis=-2)


def _fitted(points: Array, source: NDArray[np.int_]) -> Array:
    """Return the orthogonal map (D, D) that takes `points[source]` to `points` best.

    Source: Schoenemann (1966), Psychometrika 31, "A generalized solution of the orthogonal
    Procrustes problem". Entries that rounding keeps from 0, 1 or -1 are made so.
    """
    U, _, Vt = np.linalg.svd(points.T @ points[source])
    Q = U @ Vt
    return np.where(np.abs(Q - Q.round()) < 1e-12, Q.round() + 0.0, Q)


def _closed(found: Sequence[Symmetry]) -> list[Symmetry]:
    """Return those that map the whole set onto itself: a group; but for rounding, all of them."""
    Q = torch.stack([symmetry.rotation for symmetry in found]).cpu().numpy()
    products = (Q[:, None] @ Q).reshape(len(Q), len(Q), -1)
    known = KDTree(Q.reshape(len(Q), -1)).query(products, distance_upper_bound=1e-4)[0]
    return [s for s, row in zip(found, known, strict=True) if np.isfinite(row).all()]

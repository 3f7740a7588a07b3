"""Symmetries of a body: isometries that map solutions to solutions of other loads."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from dpl.fem.assembly.follower_loads import NO_LOADS
from dpl.fem.problem import Problem

Array = NDArray[np.float64]

NEAR = 1e-7  # distance over L below which points coincide
SAME = 1e-11  # difference over the largest value below which fields are equal. The residual of an
# image amplifies it about a hundred times, because its forces nearly cancel.


class Symmetry(NamedTuple):
    """Isometry that maps a body onto itself.

    It maps node `source[i]` to node i and rotates vectors by Q. If u is the solution of the force
    f, then `image(u)` is that of `image(f)`.

    Attributes:
        rotation: Orthogonal matrix Q, (D, D) [-]; a reflection if det Q = -1.
        source: Node that is mapped to each node, (N,) int64.
    """

    rotation: Tensor
    source: Tensor

    @property
    def inverse(self) -> "Symmetry":
        """The symmetry that maps images back."""
        return Symmetry(self.rotation.mT, self.source.argsort())

    def image(self, field: Tensor) -> Tensor:
        """Return the image (..., N, D) of a nodal field (..., N, D)."""
        return field.index_select(-2, self.source.to(field.device)) @ self.rotation.mT.to(field)


class SymmetryGroup(tuple[Symmetry, ...]):
    """The symmetries of a body, the identity first."""

    __slots__ = ()

    @classmethod
    def identity(cls, problem: Problem) -> Self:
        """Return the group of the identity alone."""
        (nodes, dim), device = problem.shape, problem.points.device
        rotation = torch.eye(dim, dtype=torch.float64, device=device)
        return cls([Symmetry(rotation, torch.arange(nodes, device=device))])

    @property
    def rotations(self) -> Tensor:
        """Matrices Q of the members on the CPU, (G, D, D) [-]."""
        return torch.stack([symmetry.rotation for symmetry in self]).cpu()

    @property
    def diagonal(self) -> Tensor:
        """Numbers of the members with diagonal Q, a subgroup, (M,): reflections and half turns."""
        Q = self.rotations
        others = Q - torch.diag_embed(Q.diagonal(dim1=1, dim2=2))
        return (~others.flatten(1).any(dim=1)).nonzero()[:, 0]

    def coset_representatives(self) -> list[Symmetry]:
        """Return one member g of each coset of `diagonal`, the identity first.

        Each member of the group is a product h g with h in `diagonal`: first g, then h.
        """
        Q = self.rotations
        products = (Q[self.diagonal][:, None] @ Q).flatten(2)
        numbers = torch.cdist(products, Q.flatten(1)).argmin(dim=2)  # of h g, (M, G)
        return [self[k] for k in numbers.amin(dim=0).unique().tolist()]

    def images(self, field: Tensor, which: Tensor) -> Tensor:
        """Return the images of nodal fields (B, N, D) under the members `which`, (B,)."""
        image = field.clone()
        for k, symmetry in enumerate(self[1:], 1):
            chosen = which == k
            if chosen.any():
                image[chosen] = symmetry.image(field[chosen])
        return image

    def cell_images(self, problem: Problem) -> Tensor:
        """Return the cell to which each member maps each cell of the body, (G, E) int64.

        Cells are recognised by their set of nodes, as a sum of random numbers of the nodes.
        """
        cells = problem.cells.cpu()
        random = torch.Generator().manual_seed(0)
        names = torch.randint(2**62, (problem.shape[0],), generator=random)  # sums may wrap around
        order = names[cells].sum(dim=1).sort()
        nodes = (symmetry.source.cpu().argsort() for symmetry in self)
        sums = torch.stack([names[node[cells]].sum(dim=1) for node in nodes])
        return order.indices[torch.searchsorted(order.values, sums)]


NO_SYMMETRIES = SymmetryGroup()  # samples have no images


def symmetries(problem: Problem, *, also: Sequence[Tensor] = ()) -> SymmetryGroup:
    """Return the symmetry group of a body in a reproducible order, the identity first.

    A symmetry maps nodes to nodes and commutes with the boundary conditions and with the internal
    force, which is tested on two fixed displacements.

    Args:
        problem: The body. A body with coincident nodes has the identity only.
        also: Nodal fields (N, D) that a symmetry must preserve, such as a constant force.
    """
    points = problem.points.cpu().numpy()
    points = points - points.mean(axis=0)  # the centre is a fixed point of every symmetry
    fixed = [problem.prescribed, *also]
    operators, fields = _operators(problem), _fields(problem, points)
    results = [operator(fields) for operator in operators]

    def holds(symmetry: Symmetry) -> bool:
        return all(_same(symmetry.image(field), field) for field in fixed) and all(
            _same(operator(symmetry.image(fields)), symmetry.image(result))
            for operator, result in zip(operators, results, strict=True)
        )

    motions = _motions(points, np.count_nonzero(problem.free.cpu().numpy(), axis=1))
    moved = [Symmetry(*(part.to(fields.device) for part in pair)) for pair in motions]
    found = list(filter(holds, moved)) or SymmetryGroup.identity(problem)
    Q = torch.stack([symmetry.rotation for symmetry in found]).cpu().numpy()
    products = (Q[:, None] @ Q).reshape(len(Q), len(Q), -1)
    known = KDTree(Q.reshape(len(Q), -1)).query(products, distance_upper_bound=1e-4)[0]
    # a group: the members whose products with all others are in the set
    closed = [s for s, row in zip(found, known, strict=True) if np.isfinite(row).all()]
    return SymmetryGroup(sorted(closed, key=lambda symmetry: symmetry.source.tolist()))


def _operators(problem: Problem) -> list[Callable[[Tensor], Tensor]]:
    """Return the operators that commute with a symmetry: constraints, cells and loads.

    The parameters of the law are no equal fractions of their ranges: laws of two regions that are
    equal for these parameters are equal for all.
    """
    loads = [problem.follower_loads.generic.force] if problem.follower_loads else []
    springs = [] if problem.springs is None else [problem.springs.force]
    ranges = problem.material.parameter_ranges.values()
    values = [ends.at((k + 1) / (len(ranges) + 1)) for k, ends in enumerate(ranges)]
    law = problem.material.with_parameters(torch.tensor([values], dtype=torch.float64))
    cells = replace(problem, material=law, springs=None, follower_loads=NO_LOADS)
    operators: list[Callable[[Tensor], Tensor]] = [
        lambda field: torch.where(problem.free, field, 0.0),
        lambda field: cells.evaluate(field).internal,
    ]
    return [*operators, *springs, *loads]


def _fields(problem: Problem, points: Array) -> Tensor:
    """Return two displacements without any symmetry, waves and noise, (2, N, D) [-].

    They are scaled to |H| < 1/2, so that neither they nor their images invert a cell.
    """
    rng, dim = np.random.default_rng(0), points.shape[1]
    waves = np.sin(4 * points @ rng.standard_normal((dim, dim)) + rng.uniform(0, 6, dim))
    fields = torch.from_numpy(np.stack([waves, rng.uniform(-1, 1, points.shape)]))
    fields = fields.to(problem.points.device)
    steepest = problem.dN.norm(dim=-1).sum(dim=-1).max()
    return fields / (2 * steepest * fields.norm(dim=-1).amax(dim=-1))[:, None, None]


def _same(found: Tensor, expected: Tensor) -> bool:
    """Return True if fields (..., N, D) are equal up to rounding; False if they contain NaN."""
    error, size = (x.abs().amax(dim=(-2, -1)) for x in (found - expected, expected))
    return bool((error <= SAME * size).all())


def _motions(points: Array, marks: NDArray[np.int_]) -> list[tuple[Tensor, Tensor]]:
    """Return all isometries about the origin that map nodes (N, D) to nodes, as in `Symmetry`.

    A node and its image have the same mark, (N,).
    """
    distance = _classes(np.linalg.norm(points, axis=1))
    kinds = np.unique(np.stack([distance, marks]), axis=1, return_inverse=True)[1].ravel()
    tree, candidates = KDTree(points), _candidates(points, kinds)
    probes = points[:: 1 + len(points) // 16] @ candidates.mT  # (C, 16, D): a fast first test
    candidates = candidates[np.isfinite(tree.query(probes, distance_upper_bound=NEAR)[0]).all(1)]
    motions = []
    for Q in candidates:
        # Q maps the node at Q^-1 x_i to x_i
        gap, source = tree.query(points @ Q, distance_upper_bound=NEAR)
        if np.isfinite(gap).all() and len(np.unique(source)) == len(source):
            motions.append((torch.from_numpy(_fitted(points, source)), torch.from_numpy(source)))
    return motions


def _classes(values: Array) -> NDArray[np.int_]:
    """Return the index of the cluster of each value, (N,); gaps above `NEAR` separate clusters."""
    order = np.argsort(values)
    classes = np.empty(len(values), dtype=np.int64)
    classes[order] = np.cumsum(np.diff(values[order], prepend=values.min()) > NEAR)
    return classes


def _candidates(points: Array, kinds: NDArray[np.int_]) -> Array:
    """Return candidate orthogonal maps (C, D, D), which include all symmetries of the nodes.

    The images of D - 1 nodes that are linearly independent determine two maps, which differ by a
    reflection. The nodes are chosen from the smallest classes and mapped to all others of these.
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
    """Return D - 1 vectors (..., D - 1, D) and one orthogonal to them, (..., D, D)."""
    if vectors.shape[-1] == 2:
        across = vectors[..., ::-1] * [-1.0, 1.0]
    else:
        across = np.cross(vectors[..., :1, :], vectors[..., 1:, :])
    return np.concatenate([vectors, sense * across], axis=-2)


def _fitted(points: Array, source: NDArray[np.int_]) -> Array:
    """Return the orthogonal map (D, D) that maps `points[source]` to `points` in least squares.

    Source: Schoenemann (1966), Psychometrika 31, "A generalized solution of the orthogonal
    Procrustes problem". Entries are rounded to 0, 1 or -1 where they differ by less than 1e-12.
    """
    U, _, Vt = np.linalg.svd(points.T @ points[source])
    Q = U @ Vt
    return np.where(np.abs(Q - Q.round()) < 1e-12, Q.round() + 0.0, Q)

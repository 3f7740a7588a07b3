"""Random uniform tractions on random discs of the boundary."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from dpl.fem.loads.family import SurfaceLoads
from dpl.fem.loads.forces import ROUNDOFF, facet_areas
from dpl.fem.loads.sampling import Array
from dpl.fem.loads.sized import SizedLoads, deflections, softest_node
from dpl.fem.options import option

MAX_ROUNDS = 5  # of decisions about loaded facets; a disc away from supports needs one or two


@dataclass(frozen=True, eq=False)
class PatchLoads(SurfaceLoads, SizedLoads):
    """Uniform dead traction of random direction and size on a random geodesic disc.

    The disc consists of the facets around a random vertex outside the supports and of those whose
    vertices are all within a random distance of it. The distance is the length of the shortest path
    along edges and diagonals of facets, so that a disc does not jump across a gap.

    Attributes:
        largest: Largest traction [Pa]; None: `deflection` decides, with the largest disc around the
            node that yields most to forces.
        patch_radius: Smallest and largest radius of the disc over L [-].
    """

    largest: float | None = option("Pa", default=None, above=0.0)
    patch_radius: Sequence[float] = option("times L", default=(0.0, 0.5), least=0.0)

    @property
    def unit_deflection(self) -> float:
        """Linear deflection [-] of the traction 1 on the largest disc at the softest vertex."""
        linear, nodes = self.linear.reference, self.problem.basis.nodal_dofs[0]  # of vertices
        softest = softest_node(linear, torch.from_numpy(nodes[self.centres]))
        vertex = int(self.centres[np.flatnonzero(nodes[self.centres] == softest)[0]])
        axes = torch.eye(self.problem.shape[1], dtype=torch.float64)
        weights = self.weights_of(vertex, self.patch_radius[1])
        return float(deflections(linear, torch.einsum("n,kd->knd", weights, axes)).max())

    @property
    def largest_force(self) -> float:
        """Norm of the largest traction on all facets [-], which no disc exceeds."""
        areas = torch.from_numpy(np.asarray(self._areas.sum(axis=1)))  # (N, 1)
        norms = self.problem.acting(areas.expand(self.problem.shape)).norm(dim=0)
        return self.largest_size * float(norms.max())

    @property
    def n_force(self) -> int:
        """D + 2: centre and radius, then size and direction."""
        return self.problem.shape[1] + 2

    def force_at(self, point: Array) -> Tensor:
        low, high = self.patch_radius
        vertex = int(self.centres[int(point[0] * len(self.centres))])
        weights = self.weights_of(vertex, low + (high - low) * float(point[1]))
        return torch.outer(weights, torch.from_numpy(self.vector_at(point[2:])))

    def project(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return the largest nodal force per nodal area over `largest`, (B,), and residuals, (B,).

        The residual is that of the uniform traction that fits best, in the direction of this nodal
        force and on the facets that are loaded. These facets need not be a disc.
        """
        pairs = [self._fit(own) for own in self.own_force(force).numpy()]
        tractions, residuals = zip(*pairs, strict=True)
        return force.new_tensor(tractions) / self.largest_size, force.new_tensor(residuals)

    def _fit(self, force: Array) -> tuple[float, float]:
        """Return the largest nodal traction [-] and the residual of a force (N, D)."""
        if (unit := np.abs(force).max()) == 0:
            return 0.0, 0.0
        force, (index, others, sizes, free, _) = force / unit, self._loadable
        there, total = force.take(index), np.linalg.norm(force)
        tractions = there / sizes
        norms = np.sqrt(np.einsum("dn,dn->n", tractions, tractions))
        if not norms.max() > 0:
            return 0.0, 1.0
        traction = tractions[:, norms.argmax()]
        parts = _parts(tractions, traction, free)
        is_partly_fixed = bool((free.any(axis=0) & ~free.all(axis=0)).any())  # at some node
        for _ in range(is_partly_fixed * (len(traction) - 1)):  # components fixed at that node
            known = np.nan_to_num(parts)
            traction = tractions @ known / np.maximum(free @ known**2, 1e-300)
            parts = _parts(tractions, traction, free)
        largest = np.nanmax(parts)
        model = free * traction[:, None] * self._disc_weights(parts / largest * sizes)
        rest = there - np.vdot(model, there) / np.maximum(np.vdot(model, model), 1e-300) * model
        size = np.maximum(largest * np.linalg.norm(traction), norms.max())
        distance = np.hypot(np.linalg.norm(rest), np.linalg.norm(force.take(others))) / total
        return float(unit * size), float(distance)

    def _disc_weights(self, weights: Array) -> Array:
        """Return the sums (n,) of the areas of loaded facets at each node that resemble `weights`.

        A facet is loaded if the weight of a node requires it, and is not if a weight has no room
        for it. This decides about the facets of a disc; of other loads the rest counts as loaded.
        Weights that are NaN are unknown; undecided facets at such nodes may be loaded in part.
        """
        areas, (corners, low, high) = self._loadable[-1], self._shares
        halves, wanted = low, weights.take(corners)
        unknown = np.isnan(wanted)
        undecided = ~unknown.all(axis=0)
        loaded = np.zeros(areas.shape[1])
        for _ in range(MAX_ROUNDS):
            required = undecided & (wanted > high).any(axis=0)
            excluded = undecided & (wanted < low).any(axis=0)
            loaded[required & ~excluded] = 1.0
            undecided &= ~(required | excluded)
            if not undecided.any():
                return areas @ loaded
            low = (areas @ loaded).take(corners) + halves
            high = (areas @ (loaded + undecided)).take(corners) - halves
        least = areas @ (loaded + (undecided & ~unknown.any(axis=0)))
        return np.clip(np.nan_to_num(weights), least, areas @ (loaded + undecided))

    @cached_property
    def _loadable(self) -> tuple[NDArray[np.int_], NDArray[np.int_], Array, Array, csr_matrix]:
        """Degrees of freedom of the nodes of facets (D, n), other ones, and data of these nodes.

        The data are areas (n,), free components (D, n) and shares of facets (n, E).
        """
        every = np.ones(len(self.facets))
        sizes = np.copysign(abs(self._areas) @ every, self._areas @ every)  # no difference is small
        dofs, is_node = np.arange(self.problem.free.numel()).reshape(self.problem.shape), sizes != 0
        free = self.problem.free.numpy()[is_node].astype(np.float64).T.copy()
        return dofs[is_node].T.copy(), dofs[~is_node], sizes[is_node], free, self._areas[is_node]

    @cached_property
    def _shares(self) -> tuple[NDArray[np.int_], Array, Array]:
        """Nodes of each facet, numbers in `_loadable`, and bounds of their weights, (A, E) each.

        The facet is not loaded below the first bound, half its share of the area of the node, and
        is above the second, the area without this half. Bounds are infinite where a node is missing
        or has negative shares.
        """
        _, _, sizes, _, areas = self._loadable
        areas = areas.tocsc()
        counts = np.diff(areas.indptr)
        facet = np.repeat(np.arange(len(counts)), counts)
        place = np.arange(areas.nnz) - areas.indptr[facet], facet
        corners = np.zeros((counts.max(), len(counts)), dtype=np.int_)
        halves = np.full(corners.shape, -np.inf)
        corners[place] = areas.indices
        is_mixed = (areas < 0) @ np.ones(len(counts)) > 0
        halves[place] = np.where(is_mixed[areas.indices], -np.inf, areas.data / 2)
        return corners, halves, sizes[corners] - halves

    def weights_of(self, vertex: int, radius: float) -> Tensor:
        """Return the integral of each shape function over a disc around a vertex, (N,) [-]."""
        distance = dijkstra(self._graph, indices=vertex, limit=radius * (1 + 1e-9))
        inside = np.isfinite(distance)[self._vertices].all(axis=0)
        around = (self._vertices == vertex).any(axis=0)
        return torch.from_numpy(self._areas @ (inside | around).astype(np.float64))

    @cached_property
    def centres(self) -> NDArray[np.int_]:
        """Vertices of the mesh on `facets` with a free degree of freedom, ascending, (V,)."""
        vertices = np.unique(self._vertices)
        nodes = self.problem.basis.nodal_dofs[0][vertices]
        return vertices[self.loadable_dofs.any(dim=1).numpy()[nodes]]

    @cached_property
    def _vertices(self) -> NDArray[np.int_]:
        """Vertices of each facet, (A, E)."""
        return np.asarray(self.problem.mesh.facets[:, self.facets])

    @cached_property
    def _areas(self) -> csr_matrix:
        return facet_areas(self.problem, self.facets)

    @cached_property
    def _graph(self) -> csr_matrix:
        """Lengths of edges and diagonals of the facets, between vertices of the mesh."""
        points = self.problem.mesh.p.T
        pairs = np.hstack(
            [self._vertices[[i, j]] for i, j in combinations(range(len(self._vertices)), 2)]
        )
        start, end = np.unique(np.sort(pairs, axis=0), axis=1)
        lengths = np.linalg.norm(points[start] - points[end], axis=1)
        both = np.concatenate([start, end]), np.concatenate([end, start])
        return csr_matrix((np.tile(lengths, 2), both), (len(points), len(points)))


def _parts(tractions: Array, traction: Array, free: Array) -> Array:
    """Return nodal tractions (D, n) over a traction (D,) in its free components, NaN for none."""
    squares, parts = traction**2 @ free, np.full(free.shape[1], np.nan)
    least = ROUNDOFF * np.vdot(traction, traction)
    return np.divide(traction @ tractions, squares, out=parts, where=squares > least)

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

from dpl.fem.loads.forces import facet_areas
from dpl.fem.loads.sampling import Array
from dpl.fem.loads.sized import (
    SizedLoads,
    check_largest,
    largest_deflection,
    softest_node,
    traction_sizes,
)
from dpl.fem.loads.surface import SurfaceLoads, check_patch_radius


@dataclass(frozen=True, eq=False)
class PatchLoads(SurfaceLoads, SizedLoads):
    """Uniform dead traction of random direction and size on a random geodesic disc.

    The disc consists of the facets around a random vertex outside the supports and of those whose
    vertices are all within a random distance of it. The distance is the length of the shortest path
    along edges and diagonals of facets, so that a disc does not jump across a gap.

    The point of a load has centre, radius, size and direction, then Young's modulus and, where the
    law has ranges, its parameters.

    Attributes:
        largest: Largest traction [Pa]; None: `deflection` decides, with the largest disc around the
            node that yields most to forces.
        patch_radius: Smallest and largest radius of the disc over L [-].
    """

    largest: float | None = None
    patch_radius: Sequence[float] = (0.0, 0.5)

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: An attribute is out of range.
        """
        check_largest("largest", self.largest, "Pa")
        check_patch_radius(self.patch_radius)
        super().__post_init__()

    @property
    def given_sizes(self) -> Array | None:
        """0 and the largest traction over E, (2,) [-]."""
        return traction_sizes(self.problem.units, self.largest)

    @property
    def unit_deflection(self) -> float:
        """Linear deflection [-] of the traction 1 on the largest disc at the softest vertex."""
        linear, nodes = self.linear.reference, self._nodes
        softest = softest_node(linear, torch.from_numpy(nodes[self.centres]))
        vertex = int(self.centres[np.flatnonzero(nodes[self.centres] == softest)[0]])
        axes = torch.eye(self.problem.shape[1], dtype=torch.float64)
        weights = self.weights_of(vertex, self.patch_radius[1])
        return largest_deflection(linear, torch.einsum("n,kd->knd", weights, axes))

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
        """Return the force (N, D) [-] of a point (n_force,) of the unit cube."""
        low, high = self.patch_radius
        vertex = int(self.centres[int(point[0] * len(self.centres))])
        weights = self.weights_of(vertex, low + (high - low) * float(point[1]))
        return torch.outer(weights, torch.from_numpy(self.vector_at(point[2:])))

    def weights_of(self, vertex: int, radius: float) -> Tensor:
        """Return the integral of each shape function over a disc, (N,) [-].

        Args:
            vertex: Number of the vertex of the mesh at the centre.
            radius: Radius [-].
        """
        distance = dijkstra(self._graph, indices=vertex, limit=radius * (1 + 1e-9))
        inside = np.isfinite(distance)[self._vertices].all(axis=0)
        around = (self._vertices == vertex).any(axis=0)
        return torch.from_numpy(self._areas @ (inside | around).astype(np.float64))

    @cached_property
    def centres(self) -> NDArray[np.int_]:
        """Vertices of the mesh on `facets` with a free degree of freedom, ascending, (V,)."""
        vertices = np.unique(self._vertices)
        return vertices[self.loadable_dofs.any(dim=1).numpy()[self._nodes[vertices]]]

    @property
    def _nodes(self) -> NDArray[np.int_]:
        """Node of each vertex of the mesh."""
        return np.asarray(self.problem.basis.nodal_dofs[0])

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

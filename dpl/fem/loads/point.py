"""Random forces on random nodes of the boundary."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from dpl.fem.loads.family import SurfaceLoads
from dpl.fem.loads.sampling import Array
from dpl.fem.loads.sized import SizedLoads, deflections, point_forces, softest_node
from dpl.fem.options import option


@dataclass(frozen=True, eq=False)
class PointLoads(SurfaceLoads, SizedLoads):
    """Forces of random direction and size on a few random nodes of the boundary.

    The numbers of a force are the number of forces, then node, size and direction of each.

    Attributes:
        largest: Largest force [N] (2D: [N/m]); None: `deflection` decides, with all forces at the
            node that yields most to them.
        count: Smallest and largest number of forces, on different nodes.
    """

    largest: float | None = option("N", default=None, above=0.0)
    count: Sequence[int] = option("", default=(1, 3), least=1)

    @cached_property
    def nodes(self) -> Tensor:
        """Nodes on which a force can act, ascending, (n,)."""
        nodes = self.loadable_dofs.any(dim=1).nonzero()[:, 0]
        if len(nodes) < self.count[1]:
            raise ValueError(
                f"count = {list(self.count)} must be at most {len(nodes)}, the free nodes"
            )
        return nodes

    @property
    def unit_deflection(self) -> float:
        """Largest linear deflection [-] of all forces of size 1 at the softest node."""
        linear = self.linear.reference
        axes = point_forces(self.problem.shape, [softest_node(linear, self.nodes)])
        return self.count[1] * float(deflections(linear, axes).max())

    @property
    def largest_force(self) -> float:
        """Norm of the largest number of largest forces [-]."""
        self.nodes  # noqa: B018  # raises if there are too few
        return self.largest_size * self.count[1] ** 0.5

    @property
    def n_force(self) -> int:
        """1 + (D + 1) times the largest number of forces."""
        return 1 + (1 + self.problem.shape[1]) * self.count[1]

    def force_at(self, point: Array) -> Tensor:
        low, high = self.count
        count = low + int(point[0] * (high - low + 1))
        force = torch.zeros(self.problem.shape, dtype=torch.float64)
        nodes = self.nodes.tolist()
        for node, *vector in point[1:].reshape(high, -1)[:count]:
            force[nodes.pop(int(node * len(nodes)))] = torch.from_numpy(
                self.vector_at(np.array(vector))
            )
        return force

    def project(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return largest nodal forces over `largest` and the parts on further nodes, (B,) each."""
        own = self.own_force(force)
        here = torch.where(self.loadable_dofs, own, 0.0).norm(dim=2)
        sizes = here.sort(dim=1, descending=True).values
        elsewhere = torch.where(self.loadable_dofs, 0.0, own).flatten(1)
        rest = torch.cat([sizes[:, self.count[1] :], elsewhere], dim=1).norm(dim=1)
        total = own.flatten(1).norm(dim=1).clamp(min=1e-300)
        return sizes[:, 0] / self.largest_size, rest / total

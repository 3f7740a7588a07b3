"""Loads that a hand makes: of the training's modes, on an area, to move a point somewhere."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from dpl.fem import HasModes
from dpl.scene import Scene

RIDGE = 1e-2  # of the compliance squared: what only stiff modes would give is hardly asked for


class LoadRequest(NamedTuple):
    """A load as an engineer says it.

    Attributes:
        force: (N, D) [N], in 2D [N/m].
        young: E [Pa].
        poisson: Poisson's ratio [-]; None where the law has its own.
    """

    force: Tensor
    young: float
    poisson: float | None


@dataclass(frozen=True, eq=False)
class Patch:
    """Loads f = Phi q of the training on one area.

    Attributes:
        scene: The body and its loads.
        node: Centre.
        radius: Over L [-].
        uniform: One force for all nodes of the area instead: unlike the training's loads.
    """

    scene: Scene
    node: int
    radius: float
    uniform: bool = False

    @cached_property
    def inside(self) -> Tensor:
        """Nodes that loads act on, (N,)."""
        problem = self.scene.problem
        distance = (problem.points - problem.points[self.node]).norm(dim=1)
        acting = (distance <= self.radius * (1 + 1e-9)) & self.scene.loads.loadable_dofs.any(dim=1)
        acting[self.node] = True
        return acting

    @cached_property
    def fields(self) -> Tensor:
        """Loads of the largest size each, (M, N, D) [-]: of modes, or along the axes."""
        loads = self.scene.loads
        kept = self.inside[:, None] & loads.loadable_dofs
        if self.uniform or not isinstance(loads, HasModes):
            size = loads.largest_force / float(kept.any(dim=1).sum()) ** 0.5
            axes = torch.eye(kept.shape[1], dtype=torch.float64)
            return torch.where(kept, size * axes[:, None], 0.0)
        return torch.where(kept, loads.modal_forces.permute(2, 0, 1), 0.0)

    @cached_property
    def compliance(self) -> Tensor:
        """Linear displacement of the centre under each of `fields`, (D, M) [-]."""
        linear = self.scene.linear.reference
        return torch.stack([linear.solve(field)[self.node] for field in self.fields], dim=1)

    def towards(self, displacement: Tensor, *, most: float | None = 1.0) -> Tensor:
        """Return the force that, linearly, displaces the centre so, (N, D) [-].

        Of all such loads the one of the smallest modal loads over their largest.

        Args:
            displacement: (D,) [-].
            most: Amplitude that it may have, see `Scene.loads.place`; None: any.
        """
        C = self.compliance
        square = C @ C.T
        ridge = RIDGE * square.diagonal().sum() * torch.eye(len(C), dtype=C.dtype)
        share = C.T @ torch.linalg.solve(square + ridge, displacement)
        largest = float(share.abs().max())
        if most is not None and largest > most:
            share = share * (most / largest)
        return torch.einsum("m,mnd->nd", share, self.fields)

    def along(self, direction: Tensor, amplitude: float) -> Tensor:
        """Return the force that pushes the centre in a direction (D,), (N, D) [-].

        Args:
            direction: Of any length; zero gives no force.
            amplitude: Of the force, see `Scene.loads.place`: up to 1 the training's.
        """
        size = float(direction.norm())
        if size == 0:
            return torch.zeros_like(self.fields[0])
        far = direction / size * (1e6 * float(self.compliance.norm()) + 1e-300)
        return amplitude * self.towards(far)

"""Patches of the body, and the modal loads on them that move a point in a requested direction."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from dpl.fem import HasModes, RigidPatch
from dpl.scene import Scene

RIDGE = 1e-2  # Tikhonov parameter over the squared compliance; limits the use of stiff modes


@dataclass(frozen=True, eq=False)
class Patch:
    """Loads f = Phi q of the training distribution, restricted to the nodes within a radius.

    Attributes:
        scene: The body and its loads.
        node: Node at the centre.
        radius: Radius over L [-].
        uniform: Use equal forces on all nodes instead of modes, as for load families without
            modes. The training contains no such loads.
    """

    scene: Scene
    node: int
    radius: float
    uniform: bool = False

    @cached_property
    def node_mask(self) -> Tensor:
        """Mask of the loaded nodes, (N,)."""
        problem = self.scene.problem
        distance = (problem.points - problem.points[self.node]).norm(dim=1)
        mask = (distance <= self.radius * (1 + 1e-9)) & self.scene.loads.loadable_dofs.any(dim=1)
        mask[self.node] = True
        return mask

    @cached_property
    def held_nodes(self) -> Tensor:
        """Mask of the nodes that a gripper holds, those of the boundary that are free, (N,)."""
        problem = self.scene.problem
        return self.node_mask & problem.boundary & problem.free.any(dim=1)

    @cached_property
    def sliding_nodes(self) -> Tensor:
        """Mask of the nodes that are held while the patch slides, (N,); none if it cannot."""
        problem = self.scene.problem
        try:
            directions = [True] * problem.shape[1]
            held = RigidPatch.of(
                self.scene.linear, self.held_nodes.numpy(), directions, sliding=True
            )
        except ValueError:
            return torch.zeros_like(self.held_nodes)
        return held.nodes

    @cached_property
    def unit_loads(self) -> Tensor:
        """Loads of amplitude 1, of one mode or along one axis each, (M, N, D) [-]."""
        loads = self.scene.loads
        loaded = self.node_mask[:, None] & loads.loadable_dofs
        if self.uniform or not isinstance(loads, HasModes):
            size = loads.largest_force / float(loaded.any(dim=1).sum()) ** 0.5
            axes = torch.eye(loaded.shape[1], dtype=torch.float64)
            return torch.where(loaded, size * axes[:, None], 0.0)
        return torch.where(loaded, loads.modal_forces.permute(2, 0, 1), 0.0)

    @cached_property
    def compliance(self) -> Tensor:
        """Linear displacement of the centre under each unit load, (D, M) [-]."""
        linear = self.scene.linear.reference
        without = linear.solve(torch.zeros(linear.problem.shape, dtype=torch.float64))[self.node]
        return torch.stack(
            [linear.solve(load)[self.node] - without for load in self.unit_loads], dim=1
        )

    def force_towards(self, displacement: Tensor, *, max_amplitude: float | None = 1.0) -> Tensor:
        """Return the force (N, D) [-] whose linear response moves the centre by `displacement`.

        Of all such forces the one with the smallest amplitudes, by ridge regression; it is scaled
        down to `max_amplitude` of a unit load. The displacement is over L, (D,) [-].
        """
        C = self.compliance
        square = C @ C.T
        ridge = RIDGE * square.diagonal().sum() * torch.eye(len(C), dtype=C.dtype)
        amplitudes = C.T @ torch.linalg.solve(square + ridge, displacement)
        largest = float(amplitudes.abs().max())
        if max_amplitude is not None and largest > max_amplitude:
            amplitudes = amplitudes * (max_amplitude / largest)
        return torch.einsum("m,mnd->nd", amplitudes, self.unit_loads)

    def force_along(self, direction: Tensor, amplitude: float) -> Tensor:
        """Return the force (N, D) [-] whose linear response moves the centre in a direction (D,).

        Up to an amplitude of 1 of each unit load it is in the training range.
        """
        size = float(direction.norm())
        if size == 0:
            return torch.zeros_like(self.unit_loads[0])
        far = direction / size * (1e6 * float(self.compliance.norm()) + 1e-300)
        return amplitude * self.force_towards(far)

"""Patches of the body, and requests of the page: a load, or the grasp of a patch."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from dpl.fem import Load, ModalLoads, RigidPatch, Solution
from dpl.inference import Answer, GraspAnswer, Simulator
from dpl.scene import Scene

GRASP_LIMIT_MS = 5000.0  # wall time of a grasp with any other method than a budget [ms]
RIDGE = 1e-2  # Tikhonov parameter over the squared compliance; limits the use of stiff modes


@dataclass(frozen=True, eq=False)
class Patch:
    """Loads f = Phi q of the training distribution, restricted to the nodes within a radius."""

    scene: Scene
    node: int  # at the centre
    radius: float  # over L [-]

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
        linear, directions = self.scene.linear, [True] * self.scene.problem.shape[1]
        try:
            return RigidPatch.of(linear, self.held_nodes.numpy(), directions, sliding=True).nodes
        except ValueError:
            return torch.zeros_like(self.held_nodes)

    @cached_property
    def unit_loads(self) -> Tensor:
        """Loads of amplitude 1, of one mode or along one axis each, (M, N, D) [-].

        Families without modes have equal forces on all nodes, which their training may not contain.
        """
        loads = self.scene.loads
        loaded = self.node_mask[:, None] & loads.loadable_dofs
        if not isinstance(loads, ModalLoads):
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

    def force_towards(self, displacement: Tensor) -> Tensor:
        """Return the force (N, D) [-] whose linear response moves the centre by `displacement`.

        Of all such forces the one with the smallest amplitudes, by ridge regression; it is scaled
        down to the size of a unit load. The displacement is over L, (D,) [-].
        """
        C = self.compliance
        square = C @ C.T
        ridge = RIDGE * square.diagonal().sum() * torch.eye(len(C), dtype=C.dtype)
        amplitudes = C.T @ torch.linalg.solve(square + ridge, displacement)
        amplitudes = amplitudes / max(float(amplitudes.abs().max()), 1.0)
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


@dataclass(frozen=True, eq=False)
class LoadRequest:
    """A load in SI units."""

    varying: ClassVar[tuple[str, ...]] = ("force", "young")  # between two frames
    force: Tensor  # (N, D) [N], in 2D [N/m]
    young: float  # [Pa]
    parameters: Mapping[str, float]  # value of each range of the law, by name

    def continues(self, other: "LoadRequest") -> bool:
        """Return True if the page interpolates from another request to this one."""
        return type(self) is type(other)

    def interpolate(self, goal: Self, share: float) -> Self:
        """Return the request at a share of the way from this one (0) to a goal (1)."""
        between = {n: a + share * (b - a) for n, a, b in self._pairs(goal)}
        return replace(goal, **between)

    def distance(self, goal: Self) -> float:
        """Return the largest change on the way to a goal, over the larger of the two values [-]."""
        norm = np.linalg.norm
        changes = [norm(b - a) / (max(norm(a), norm(b)) or 1.0) for _, a, b in self._pairs(goal)]
        return float(max(changes))

    def _pairs(self, goal: Self) -> list[tuple[str, Any, Any]]:
        return [(name, getattr(self, name), getattr(goal, name)) for name in self.varying]

    def dimensionless(self, scene: Scene) -> Load:
        """Return the load of the mechanics, with B = 1."""
        young = torch.tensor([self.young]).double()
        parameters = torch.tensor([list(self.parameters.values())]).double()
        return scene.load_of(self.force[None], young, parameters)

    def answer(
        self, simulator: Simulator, tol: float | None, budget_ms: float | None = None
    ) -> Answer | GraspAnswer:
        """Return the answer of a simulator; see `Simulator` for the arguments."""
        young, parameters = self.young, self.parameters
        return simulator(
            self.force, young=young, parameters=parameters, tol=tol, budget_ms=budget_ms
        )

    def hand_force(self, answer: Any) -> Tensor:
        """Return the forces of the hand, (N, D) [N], in an answer."""
        return self.force

    def load(self, answer: Any) -> "LoadRequest":
        """Return the load on the body in an answer."""
        return self

    def amplitude(self, answer: Any, scene: Scene) -> float:
        """Return the amplitude of the load over the largest of the training [-]."""
        return float(answer.amplitude)

    def newton_states(self, scene: Scene) -> Iterator[Solution]:
        """Yield the iterates of the solver of a scene from zero displacement."""
        return iter(scene.solver.iterate(self.dimensionless(scene)))


@dataclass(frozen=True, eq=False)
class GraspRequest(LoadRequest):
    """A patch of the boundary that is moved as a rigid body, under the other forces on the body."""

    varying: ClassVar[tuple[str, ...]] = ("force", "young", "translation", "rotation")
    nodes: Tensor  # mask of the nodes of the patch, (N,)
    translation: Tensor  # of the mean of the patch over L, (D,) [-]
    rotation: Tensor  # rotation vector about it, (3,), in 2D the angle, (1,) [rad]
    sliding: bool = False  # in the plane across its normal, see `Gripper`

    def continues(self, other: LoadRequest) -> bool:
        """Return True if another request grasps the same patch in the same way."""
        if not isinstance(other, GraspRequest) or self.sliding != other.sliding:
            return False
        return torch.equal(self.nodes, other.nodes)

    def answer(
        self, simulator: Simulator, tol: float | None, budget_ms: float | None = None
    ) -> GraspAnswer:
        """Return the answer from the state of the last grasp, in at most `GRASP_LIMIT_MS`."""
        hand = replace(simulator.grasp, warm=True, sliding=self.sliding)
        return hand(
            self.nodes.numpy(),
            (self.translation * simulator.scene.length).tolist(),
            self.rotation,
            force=self.force,
            young=self.young,
            parameters=self.parameters,
            tol=tol,
            budget_ms=GRASP_LIMIT_MS if budget_ms is None else budget_ms,
        )

    def hand_force(self, answer: Any) -> Tensor:
        """Return the forces of the gripper, (N, D) [N]."""
        return torch.from_numpy(answer.nodal_force)

    def load(self, answer: Any) -> LoadRequest:
        """Return the load on the body: the forces of the gripper and the other forces."""
        force = self.force + self.hand_force(answer)
        return LoadRequest(force, self.young, self.parameters)

    def amplitude(self, answer: Any, scene: Scene) -> float:
        """Return the amplitude of equal forces on the patch with the sum of the gripper's [-].

        That of the forces themselves is large, because they are concentrated at the edge.
        """
        unit = self.young * scene.force_unit * scene.loads.largest_force
        return float(np.linalg.norm(answer.force)) / (unit * float(self.nodes.sum()) ** 0.5)

    def newton_states(self, scene: Scene) -> Iterator[Solution]:
        """Yield the iterates of Newton's method from rest, with the patch as a moved support."""
        load = self.dimensionless(scene)
        linear = scene.linear.with_parameters(load.parameters)
        directions = [True] * len(self.translation)
        patch = RigidPatch.of(linear, self.nodes.numpy(), directions, sliding=self.sliding)
        motion = patch.displacement(self.translation.tolist(), self.rotation.tolist())
        newton = patch.newton(scene.newton, motion)
        return newton.iterate(Load(load.force, load.young))  # the body has its parameters


MakeRequest = Callable[[], LoadRequest]  # called in the thread of the worker

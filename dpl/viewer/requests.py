"""Patches of the body, and requests of the page: a load, or the grasp of a patch."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from dpl.fem import HasModes, Load, RigidPatch, Solution
from dpl.inference import Answer, GraspAnswer, Simulator
from dpl.scene import Scene

GRASP_LIMIT_MS = 5000.0  # wall time of a grasp with any other method than a budget [ms]
RIDGE = 1e-2  # Tikhonov parameter over the squared compliance; limits the use of stiff modes


@dataclass(frozen=True, eq=False)
class Patch:
    """Loads f = Phi q of the training distribution, restricted to the nodes within a radius.

    Attributes:
        scene: The body and its loads.
        node: Node at the centre.
        radius: Radius over L [-].
    """

    scene: Scene
    node: int
    radius: float

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
        """Loads of amplitude 1, of one mode or along one axis each, (M, N, D) [-].

        Families without modes have equal forces on all nodes, which their training may not contain.
        """
        loads = self.scene.loads
        loaded = self.node_mask[:, None] & loads.loadable_dofs
        if not isinstance(loads, HasModes):
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


class LoadRequest(NamedTuple):
    """A load in SI units.

    Attributes:
        force: (N, D) [N], in 2D [N/m].
        young: Young's modulus [Pa].
        parameters: Value of each range of the law, by name.
    """

    force: Tensor
    young: float
    parameters: Mapping[str, float]

    @property
    def coordinates(self) -> Tensor:
        """The forces, by which the page interpolates between loads."""
        return self.force.flatten()

    def continues(self, other: "ViewRequest") -> bool:
        """Return True if the page interpolates from another request to this one."""
        return isinstance(other, LoadRequest)

    def at(self, coordinates: Tensor) -> "LoadRequest":
        """Return the load with other forces."""
        return self._replace(force=coordinates.view_as(self.force))

    def with_moduli(self, young: float, parameters: Mapping[str, float]) -> "LoadRequest":
        """Return the load on a body with another modulus [Pa] and other parameters of the law."""
        return self._replace(young=young, parameters=parameters)

    def dimensionless(self, scene: Scene) -> Load:
        """Return the load of the mechanics, with B = 1."""
        young = torch.tensor([self.young]).double()
        parameters = torch.tensor([list(self.parameters.values())]).double()
        return scene.load_of(self.force[None], young, parameters)

    def answer(
        self,
        simulator: Simulator,
        tol: float | None,
        budget_ms: float | None = None,
        *,
        warm: bool = False,
    ) -> Answer:
        """Return the answer of a simulator; see `Simulator` for the arguments."""
        return simulator(
            self.force,
            young=self.young,
            tol=tol,
            budget_ms=budget_ms,
            warm=warm,
            parameters=self.parameters,
        )

    def load(self, answer: Answer | GraspAnswer) -> "LoadRequest":
        """Return the load on the body."""
        return self

    def amplitude(self, answer: Answer | GraspAnswer, scene: Scene) -> float:
        """Return the amplitude of the load over the largest of the training [-]."""
        return float(answer.amplitude)

    def newton_states(self, scene: Scene) -> Iterator[Solution]:
        """Yield the iterates of the solver of a scene from zero displacement."""
        return iter(scene.solver.iterate(self.dimensionless(scene)))


class GraspRequest(NamedTuple):
    """A patch of the boundary that is moved as a rigid body.

    Attributes:
        nodes: Mask of the nodes of the patch, (N,).
        translation: Displacement of the mean of the patch over L, (D,) [-].
        rotation: Rotation vector about it, (3,), in 2D the angle, (1,) [rad].
        others: The other forces on the body, and the moduli.
        sliding: True if the patch slides in the plane across its normal, see `Simulator.grasp`.
    """

    nodes: Tensor
    translation: Tensor
    rotation: Tensor
    others: LoadRequest
    sliding: bool = False

    @property
    def young(self) -> float:
        """Young's modulus [Pa]."""
        return self.others.young

    @property
    def parameters(self) -> Mapping[str, float]:
        """Value of each range of the law, by name."""
        return self.others.parameters

    @property
    def coordinates(self) -> Tensor:
        """Translation and rotation, by which the page interpolates between grasps."""
        return torch.cat([self.translation, self.rotation])

    def continues(self, other: "ViewRequest") -> bool:
        """Return True if the page interpolates from another request to this one."""
        if not isinstance(other, GraspRequest) or self.sliding != other.sliding:
            return False
        return torch.equal(self.nodes, other.nodes)

    def at(self, coordinates: Tensor) -> "GraspRequest":
        """Return the grasp with another motion."""
        translation, rotation = coordinates.split([len(self.translation), len(self.rotation)])
        return self._replace(translation=translation, rotation=rotation)

    def with_moduli(self, young: float, parameters: Mapping[str, float]) -> "GraspRequest":
        """Return the grasp of a body with another modulus [Pa] and other parameters of the law."""
        return self._replace(others=self.others.with_moduli(young, parameters))

    def answer(
        self,
        simulator: Simulator,
        tol: float | None,
        budget_ms: float | None = None,
        *,
        warm: bool = True,
    ) -> GraspAnswer:
        """Return the answer of a simulator, which begins with the forces of the last grasp.

        Without a budget it takes `GRASP_LIMIT_MS` at most.
        """
        return simulator.grasp(
            self.nodes.numpy(),
            (self.translation * simulator.scene.length).tolist(),
            self.rotation,
            force=self.others.force,
            young=self.young,
            parameters=self.parameters,
            tol=tol,
            budget_ms=GRASP_LIMIT_MS if budget_ms is None else budget_ms,
            warm=warm,
            sliding=self.sliding,
        )

    def load(self, answer: Answer | GraspAnswer) -> LoadRequest:
        """Return the load on the body: the forces of the gripper and the other forces."""
        assert isinstance(answer, GraspAnswer)
        gripper = torch.from_numpy(answer.nodal_force)
        return self.others._replace(force=self.others.force + gripper)

    def amplitude(self, answer: Answer | GraspAnswer, scene: Scene) -> float:
        """Return the amplitude of equal forces on the patch with the sum of the gripper's [-].

        That of the forces themselves is large, because they are concentrated at the edge.
        """
        assert isinstance(answer, GraspAnswer)
        unit = self.young * scene.force_unit * scene.loads.largest_force
        total = float(torch.from_numpy(answer.force).norm())
        return total / (unit * float(self.nodes.sum()) ** 0.5)

    def newton_states(self, scene: Scene) -> Iterator[Solution]:
        """Yield the iterates of Newton's method from rest, with the patch as a moved support."""
        load = self.others.dimensionless(scene)
        linear = scene.linear.with_parameters(load.parameters)
        directions = [True] * len(self.translation)
        patch = RigidPatch.of(linear, self.nodes.numpy(), directions, sliding=self.sliding)
        motion = patch.displacement(self.translation.tolist(), self.rotation.tolist())
        newton = patch.newton(scene.newton, motion)
        return newton.iterate(Load(load.force, load.young))  # the body has its parameters


ViewRequest = LoadRequest | GraspRequest
MakeRequest = Callable[[], ViewRequest]  # called in the thread of the worker


def interpolate(start: ViewRequest, end: ViewRequest, share: float) -> ViewRequest:
    """Return the request at a share of the way from `start` (0) to `end` (1)."""
    if share >= 1:
        return end
    between = end.at(torch.lerp(start.coordinates, end.coordinates, share))
    return between.with_moduli(start.young + share * (end.young - start.young), end.parameters)


def scale_of(start: ViewRequest, goal: ViewRequest) -> float:
    """Return the larger norm of the coordinates of two requests; 1 if both are zero."""
    return max(float(start.coordinates.norm()), float(goal.coordinates.norm())) or 1.0


def distance(request: ViewRequest, goal: ViewRequest, scale: float) -> float:
    """Return the larger of the differences of coordinates over `scale` and of E over the goal's."""
    apart = float((goal.coordinates - request.coordinates).norm()) / scale
    return max(apart, abs(goal.young - request.young) / goal.young)

"""Requests of the page: a load, or the grasp of a patch. The simulator answers both."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from dpl.fem import Load, RigidPatch, Solution
from dpl.inference import Answer, GraspAnswer, Simulator
from dpl.scene import Scene

GRASP_LIMIT_MS = 5000.0  # wall time of a grasp with any other method than a budget [ms]


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

    def at(self, coordinates: Tensor, young: float) -> "LoadRequest":
        """Return the load with other forces and another modulus [Pa]."""
        return self._replace(force=coordinates.view_as(self.force), young=young)

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

    def at(self, coordinates: Tensor, young: float) -> "GraspRequest":
        """Return the grasp with another motion and another modulus [Pa]."""
        translation, rotation = coordinates.split([len(self.translation), len(self.rotation)])
        others = self.others._replace(young=young)
        return self._replace(translation=translation, rotation=rotation, others=others)

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


def interpolate(start: ViewRequest, end: ViewRequest, share: float) -> ViewRequest:
    """Return the request at a share of the way from `start` (0) to `end` (1)."""
    if share >= 1:
        return end
    coordinates = torch.lerp(start.coordinates, end.coordinates, share)
    return end.at(coordinates, start.young + share * (end.young - start.young))


def scale_of(start: ViewRequest, goal: ViewRequest) -> float:
    """Return the larger norm of the coordinates of two requests; 1 if both are zero."""
    return max(float(start.coordinates.norm()), float(goal.coordinates.norm())) or 1.0


def distance(request: ViewRequest, goal: ViewRequest, scale: float) -> float:
    """Return the larger of the differences of coordinates over `scale` and of E over the goal's."""
    apart = float((goal.coordinates - request.coordinates).norm()) / scale
    return max(apart, abs(goal.young - request.young) / goal.young)

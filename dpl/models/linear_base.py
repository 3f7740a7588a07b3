"""The linear solution as the base of a prediction."""

from functools import cached_property

import torch
from torch import Tensor

from dpl.fem import Load
from dpl.fem.solvers.stiffness_terms import StiffnessTerms
from dpl.models.linear_response import LinearResponse
from dpl.scene import Scene

SCALE_STREAM = 3  # random stream of the loads for scales; samples use smaller numbers
SCALE_LOADS = 256


class LinearBase:
    """Linear solutions of batches of loads, to which networks add.

    Moved supports are part of the linear solution and keep their prescribed displacements.
    """

    def __init__(self, scene: Scene) -> None:
        """Take the scene.

        Raises:
            ValueError: K(0) changes too much with the parameters, see `StiffnessTerms`.
        """
        self._scene, self._problem = scene, scene.problem
        StiffnessTerms.of(scene.problem).require_few_steps()

    @cached_property
    def _response(self) -> LinearResponse:
        return LinearResponse(self._scene, self._scene.linear.reference.symmetries)

    def solve(self, load: Load) -> Tensor:
        """Return linear solutions, (B, N, D) [-], float64, on the device of the load."""
        force = load.force.double()
        free = self._problem.free.to(force.device)
        if self._problem.follower_loads.ranges:
            force = force - self._ranged_forces(load.parameters.to(force))
        values = self._response(force[:, free], self._problem.law_parameters(load.parameters))
        prescribed = self._problem.prescribed.to(force).flatten().expand(force.shape[0], -1)
        dofs = free.flatten().nonzero()[:, 0]
        return prescribed.index_copy(1, dofs, values).view_as(force)

    def _ranged_forces(self, parameters: Tensor) -> Tensor:
        """Return f_int at u = 0 of the follower loads with a range alone, (B, N, D) [-]."""
        problem = self._problem
        stresses = parameters[:, len(problem.material.parameter_ranges) :] / (problem.young or 1.0)
        return torch.einsum("br,rnd->bnd", stresses, self._unit_forces.to(stresses))

    @cached_property
    def _unit_forces(self) -> Tensor:
        """f_int at u = 0 of each follower load with a range at a stress of E, (R, N, D) [-]."""
        problem = self._problem
        return problem.follower_loads.unit_forces(problem.points.new_zeros(1, *problem.shape))


def sampled_solutions(scene: Scene) -> tuple[Tensor, Tensor]:
    """Return the forces and linear solutions of random loads, (S, N, D) each [-], float64.

    The loads are the first of a random stream of their own. Parameters have their values at rest.
    """
    force = scene.loads.sample((0, SCALE_STREAM), range(SCALE_LOADS)).force
    return force, torch.stack([scene.linear.reference.solve(one) for one in force])

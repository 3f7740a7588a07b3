"""The linear solution as the base of a prediction: networks learn the nonlinear displacement."""

from functools import cached_property

import torch
from torch import Tensor

from dpl.fem import Load
from dpl.fem.rom.stiffness_iteration import StiffnessIteration
from dpl.fem.solvers.stiffness_terms import StiffnessTerms
from dpl.models.linear_response import LinearResponse
from dpl.models.whitening import FieldWhitening
from dpl.scene import Scene

SCALE_STREAM = 3  # random stream of the loads for scales; samples use smaller numbers
SCALE_LOADS = 256


class LinearBase:
    """The displacement as the linear solution plus the gated output of a network.

    With the linear solution v of a load, the displacement scale s, the amplitude a = rms(v) / s and
    a whitening W of linear solutions, the network N predicts

        u = v + s a^2 / (1 + a) N(W v / rms(v), a).

    The nonlinear part of a hyperelastic displacement is O(|f|^2) at small loads and grows at most
    as fast as v at large ones; the gate a^2 / (1 + a) does both. The outputs that are wanted are
    therefore of order one for all loads, and the prediction of a small load is the linear
    solution. v determines the load, so that it replaces the force as the input of the network.
    W is `FieldWhitening`.

    Moved supports are part of the linear solution and keep their prescribed displacements.

    Attributes:
        whiten: W, a function of fields (B, N, D).
    """

    def __init__(self, scene: Scene, linear: Tensor | None = None) -> None:
        """Compute the whitening.

        Args:
            scene: The scene.
            linear: Linear solutions of random loads, (S, N, D); None for `sampled_solutions`.

        Raises:
            ValueError: K(0) changes too much with the parameters, see `StiffnessIteration`.
        """
        self._scene, self._problem = scene, scene.problem
        StiffnessIteration.of_terms(StiffnessTerms.of(scene.problem))  # may raise
        if linear is None:
            linear = sampled_solutions(scene)[1]
        fields, _ = self.scale_inputs(linear, linear.new_ones(()))
        self.whiten = FieldWhitening(fields, scene.problem.free)

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

    def scale_inputs(self, linear: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Return v / rms(v), (B, N, D), and amplitudes a, (B,).

        Args:
            linear: Linear solutions v, (B, N, D) [-].
            scale: Displacement scale s, () [-].
        """
        free = self._problem.free.to(linear.device)  # no index: a GPU would wait for its size
        square = torch.where(free, linear, 0.0).square().sum(dim=(1, 2)) / free.sum()
        size = torch.where(square > 0, square, 1.0).sqrt()  # the root has no gradient at zero
        size = torch.where(square > 0, size, 0.0)
        field = linear / torch.where(square > 0, size, 1.0)[:, None, None]
        return field, size / scale

    def scale_outputs(self, nonlinear: Tensor, amplitude: Tensor, scale: Tensor) -> Tensor:
        """Return the outputs of a network, (B, N, D), that give nonlinear displacements.

        Args:
            nonlinear: Displacements without the linear solutions, (B, N, D) [-].
            amplitude: Amplitudes of the linear solutions, (B,) [-].
            scale: Displacement scale, () [-].
        """
        factor = (scale * self.gate(amplitude))[:, None, None]
        return nonlinear / torch.where(factor > 0, factor, 1.0)

    def gate(self, amplitude: Tensor) -> Tensor:
        """Return a^2 / (1 + a), (B,), of amplitudes a (B,)."""
        return amplitude * (amplitude / (1 + amplitude))


def sampled_solutions(scene: Scene) -> tuple[Tensor, Tensor]:
    """Return the forces and linear solutions of random loads, (S, N, D) each [-], float64.

    The loads are the first of a random stream of their own. Parameters have their values at rest.
    """
    force = scene.loads.sample((0, SCALE_STREAM), range(SCALE_LOADS)).force
    return force, torch.stack([scene.linear.reference.solve(one) for one in force])

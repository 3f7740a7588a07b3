"""Bodies with another law, parameters, follower loads or supports that share all else."""

from dataclasses import replace
from functools import cached_property
from typing import Self

import torch
from torch import Tensor

from dpl.fem.assembly.equilibrium import EquilibriumCriterion
from dpl.fem.assembly.follower_loads import NO_LOADS, FollowerLoads
from dpl.fem.materials.material import Material
from dpl.fem.ranges import ParameterRange

MAX_CLONES = 64  # bodies of other parameters that are kept


class BodyVariants(EquilibriumCriterion):
    """Body that makes others on its mesh, which share pattern, gradients and kernels with it."""

    def with_parameters(self, parameters: Tensor) -> Self:
        """Return the problem with other parameters; mesh, pattern and kernels are shared.

        Args:
            parameters: Values of `parameter_ranges`, (B, P). P = 0 returns the problem itself. With
                B > 1 each member of a batch has its own: such a problem has energies, forces and
                residuals, but no tangent. It is differentiable in parameters that require a
                gradient.

        Raises:
            ValueError: The problem has another number of ranges, or the law does not allow a value.
        """
        ranges = self.parameter_ranges
        if parameters.shape[-1] != len(ranges):
            raise ValueError(
                f"a load has {parameters.shape[-1]} parameters and the body has ranges of "
                f"{list(ranges)}; give Load(force, young, parameters) one value for each"
            )
        if not ranges:
            return self
        parameters = parameters.to(self.points.device, torch.float64)
        if len(parameters) > 1 or parameters.requires_grad:
            return self._with_values(parameters)
        values = tuple(parameters[0].tolist())
        if values not in self._clones:
            if len(self._clones) >= MAX_CLONES:
                self._clones.clear()
            self._clones[values] = self._with_values(parameters)
        return self._clones[values]

    def _with_values(self, parameters: Tensor) -> Self:
        """Return the problem with values (B, P) in place of all ranges."""
        count = len(self.material.parameter_ranges)
        body = self.with_material(self.material.with_parameters(parameters[:, :count]))
        if not self.follower_loads.ranges or self.young is None:
            return body
        stresses = parameters[:, count:] / self.young
        return body._with_follower_loads(self.follower_loads.with_values(stresses))

    @property
    def parameter_ranges(self) -> dict[str, ParameterRange]:
        """Ranges of what differs between loads beside forces and Young's modulus, by name.

        They are the ranges of the law [-], then those of follower loads [Pa].
        """
        return {**self.material.parameter_ranges, **self.follower_loads.ranges}

    def law_parameters(self, parameters: Tensor) -> Tensor:
        """Return those of the parameters (B, P) that belong to the law."""
        return parameters[:, : len(self.material.parameter_ranges)]

    def ranged_force_at_rest(self, parameters: Tensor) -> Tensor:
        """Return f_int at u = 0 of the follower loads with a range alone, (B, N, D) [-].

        Args:
            parameters: Values of `parameter_ranges`, (B, P).
        """
        stresses = parameters[:, len(self.material.parameter_ranges) :]
        if self.young is not None:
            stresses = stresses / self.young
        return torch.einsum("bp,pnd->bnd", stresses, self._unit_forces_at_rest.to(stresses))

    @cached_property
    def _unit_forces_at_rest(self) -> Tensor:
        """f_int at u = 0 of each follower load with a range at a stress of E, (P, N, D) [-]."""
        return self.follower_loads.unit_forces(self.points.new_zeros(1, *self.shape))

    def with_material(self, material: Material) -> Self:
        """Return the body of another law; mesh and pattern are shared, for the same law kernels."""
        twin = self._share(replace(self, material=material))
        laws = [
            [(law.classes, len(cells)) for law, cells in one.groups(len(self.cells))]
            for one in (material, self.material)
        ]
        if laws[0] == laws[1]:
            twin.__dict__["_first"] = self
        return twin

    @cached_property
    def _clones(self) -> dict[tuple[float, ...], Self]:
        return {}

    @cached_property
    def reference(self) -> Self:
        """The problem at the middle of all ranges; itself without a range.

        Modes, scales and largest loads are those of this problem.
        """
        ranges = self.parameter_ranges.values()
        return self.with_parameters(torch.tensor([[ends.middle for ends in ranges]]).double())

    @property
    def generic(self) -> Self:
        """The problem with parameters of which no two are equal fractions of their ranges.

        Laws of two regions are equal for these parameters only if they are for all.
        """
        ranges = list(self.parameter_ranges.values())
        values = [ends.at((k + 1) / (len(ranges) + 1)) for k, ends in enumerate(ranges)]
        return self.with_parameters(torch.tensor([values]).double())

    def with_follower_factor(self, factor: float) -> Self:
        """Return the body under `factor` times its follower loads; all else is shared."""
        if not self.follower_loads or factor == 1:
            return self
        return self._with_follower_loads(self.follower_loads.scaled(factor))

    def _with_follower_loads(self, loads: FollowerLoads) -> Self:
        """Return the body with other stresses on the same facets and cells; all else is shared."""
        twin = self._share(replace(self, follower_loads=loads))
        twin.__dict__["_first"] = self.__dict__.get("_first", self)
        twin.__dict__["_follower_places"] = self._follower_places
        return twin

    @cached_property
    def without_follower_loads(self) -> Self:
        """The body without follower loads; itself if it has none."""
        if not self.follower_loads:
            return self
        twin = self._share(replace(self, follower_loads=NO_LOADS))
        twin.__dict__["_first"] = self.__dict__.get("_first", self)
        return twin

    @property
    def without_ranged_loads(self) -> Self:
        """The body with 0 in place of each follower load with a range; itself if there is none."""
        if not self.follower_loads.ranges:
            return self
        zeros = self.points.new_zeros(1, len(self.follower_loads.ranges))
        return self._with_follower_loads(self.follower_loads.with_values(zeros))

    def with_held(self, held: Tensor) -> Self:
        """Return the body with further degrees of freedom (N, D) fixed where they are at rest."""
        return replace(self, free=self.free & ~held)

    def with_prescribed(self, prescribed: Tensor) -> Self:
        """Return the body with other displacements (N, D) [-] of its supports."""
        twin = self._share(replace(self, prescribed=prescribed))
        twin.__dict__["_first"] = self.__dict__.get("_first", self)
        del twin.__dict__["moved_supports"]
        return twin

    @cached_property
    def support_force(self) -> Tensor:
        """K(0) times the prescribed displacement plus the follower loads at rest, (N, D) [-]."""
        if not self.moved_supports:
            return self.force_at_rest
        rest, moved = self.prescribed.new_zeros(1, *self.shape), self.prescribed[None]
        return self.without_follower_loads.tangent_product(rest, moved)[0] + self.force_at_rest

    def _share(self, twin: Self) -> Self:
        """Return another body on the same mesh with the parts that do not depend on the law."""
        for name in ("pattern", "moved_supports", "_operator"):
            twin.__dict__[name] = getattr(self, name)
        twin.__dict__["_same_mesh"] = self  # its recovery is built at the first use
        return twin

    @cached_property
    def has_potential(self) -> bool:
        """True if the tangent is symmetric under the follower loads, whatever their values.

        The stiffness of a follower load is at most linear in u, so that one random displacement
        decides.
        """
        random = torch.Generator().manual_seed(0)
        noise = torch.rand(1, *self.shape, generator=random, dtype=torch.float64) - 0.5
        u = torch.where(self.free, 0.1 * noise.to(self.free.device), 0.7 * self.prescribed)
        return self._follower_stiffness(self.follower_loads.generic, u)[1] is None

"""Energy, internal force and tangent of the cells of a body as batched tensor operations."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from dpl.fem.assembly.discretisation import Discretisation
from dpl.fem.assembly.mean_dilatation import MeanDilatation, PointwiseLaw
from dpl.fem.materials.material import Material
from dpl.fem.materials.tensors import green_lagrange, volume_change


@dataclass(frozen=True, eq=False)
class TensorAssembly:
    """Hyperelastic cells without foundation and follower loads.

    Methods take displacements (B, N, D) in float64 and return dimensionless tensors on the same
    device. They contain no Python loop over cells and are differentiable, except `evaluate` and
    `linearise`, which have the interface of the compiled loops.

    Attributes:
        body: Cells and shape functions.
        material: The law.
    """

    body: Discretisation
    material: Material

    @cached_property
    def law(self) -> PointwiseLaw:
        """The law at the points, with mean dilatation that of the cells."""
        if (volumes := self.body.volumes) is None:
            return PointwiseLaw(self.material)
        return MeanDilatation(self.material, volumes)

    def energy(self, displacement: Tensor) -> Tensor:
        """Return the strain energy over E L^D, (B,) [-]."""
        density = self.law.energy(self.body.gradient(displacement))
        return (density * self.body.dV).sum((-2, -1))

    def stress(self, displacement: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress over E at the quadrature points, (B,E,Q,3,3)."""
        return self.law.stress(self.body.gradient(displacement))

    def internal_force(self, displacement: Tensor) -> Tensor:
        """Return the gradient of the energy, (B, N, D) [-]."""
        return self.body.nodal_forces(self.stress(displacement))

    def tangent(self, displacement: Tensor) -> Tensor:
        """Return the entries of the second derivative of the energy on the pattern, (B, nnz)."""
        return self.body.entries(*self.law.tangent(self.body.gradient(displacement)))

    def volume_ratio(self, displacement: Tensor) -> Tensor:
        """Return min det F over the quadrature points, (B,) [-]; -inf where it is NaN."""
        change = volume_change(self.body.gradient(displacement))
        return 1 + torch.nan_to_num(change, nan=-torch.inf).flatten(1).amin(dim=1)

    def strain(self, displacement: Tensor) -> Tensor:
        """Return the Green-Lagrange strain at the quadrature points, (B, E, Q, 3, 3) [-]."""
        return green_lagrange(self.body.gradient(displacement))

    @torch.no_grad()
    def evaluate(self, displacement: Tensor) -> tuple[Tensor, Tensor]:
        """Return internal force (B, N, D) and min det F (B,)."""
        return self.internal_force(displacement), self.volume_ratio(displacement)

    @torch.no_grad()
    def linearise(self, displacement: Tensor, gap: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Return force (B, N, D), tangent (B, nnz) and min det C of the mixed points (B,).

        The strain at each mixed integration point is an independent unknown, which the point
        eliminates. Stress and moduli are evaluated at the strain of u minus the gap, and the stress
        is extrapolated linearly to the strain of u. With mean dilatation volume changes and
        pressures of the cells are unknowns too. With a zero gap, or without one, the results are
        `internal_force` and `tangent`.
        """
        H = self.body.gradient(displacement)
        if gap is None:
            stress, parts = self.law.stress(H), self.law.tangent(H)
            change = displacement.new_full((len(H),), torch.inf)
        else:
            stress, parts, change = self.law.mixed_system(H, gap)
        return self.body.nodal_forces(stress), self.body.entries(*parts), 1 + change

    def update_strain_gap(
        self, gap: Any, length: float, update: Tensor, displacement: Tensor | None = None
    ) -> Any:
        """Return the gap after a step, see `Problem.update_strain_gap`."""
        H = None if displacement is None else self.body.gradient(displacement)
        return self.law.gap_after(gap, length, self.body.gradient(update), H)

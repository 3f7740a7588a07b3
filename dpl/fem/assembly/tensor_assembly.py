"""Energy, internal force and tangent of the cells of a body as batched tensor operations."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dpl.fem.assembly import mean_dilatation
from dpl.fem.assembly.discretisation import Discretisation
from dpl.fem.assembly.mean_dilatation import MixedGap, volume_gap
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

    def energy(self, displacement: Tensor) -> Tensor:
        """Return the strain energy over E L^D, (B,) [-]."""
        H, volumes = self.body.gradient(displacement), self.body.volumes
        if volumes is None:
            density = self.material.energy(H)
        else:
            density = mean_dilatation.energy(self.material, H, volumes)
        return (density * self.body.dV).sum((-2, -1))

    def stress(self, displacement: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress over E at the quadrature points, (B,E,Q,3,3)."""
        H, volumes = self.body.gradient(displacement), self.body.volumes
        if volumes is None:
            return self.material.stress(H)
        return mean_dilatation.stress(self.material, H, volumes)

    def internal_force(self, displacement: Tensor) -> Tensor:
        """Return the gradient of the energy, (B, N, D) [-]."""
        return self.body.nodal_forces(self.stress(displacement))

    def tangent(self, displacement: Tensor) -> Tensor:
        """Return the entries of the second derivative of the energy on the pattern, (B, nnz)."""
        H, volumes = self.body.gradient(displacement), self.body.volumes
        if volumes is None:
            return self.body.entries(self.material.tangent(H))
        return self.body.entries(*mean_dilatation.tangent(self.material, H, volumes))

    def volume_ratio(self, displacement: Tensor) -> Tensor:
        """Return min det F over the quadrature points, (B,) [-]; -inf where it is NaN."""
        change = volume_change(self.body.gradient(displacement))
        return 1 + torch.nan_to_num(change, nan=-torch.inf).flatten(1).amin(dim=1)

    def strain(self, displacement: Tensor) -> Tensor:
        """Return the Green-Lagrange strain at the quadrature points, (B, E, Q, 3, 3) [-]."""
        return green_lagrange(self.body.gradient(displacement))

    def mixed_system(self, displacement: Tensor, gap: Any) -> tuple[Tensor, Tensor]:
        """Return force (B, N, D) and tangent (B, nnz) with mixed integration points (MIP).

        The strain at each quadrature point is an independent unknown, which the point eliminates.
        Stress and moduli are evaluated at the strain of u minus `gap`, (B, E, Q, 3, 3), and the
        stress is extrapolated linearly to the strain of u. With a zero gap the results are
        `internal_force` and `tangent`. With mean dilatation the gap is a `MixedGap`, and volume
        changes and pressures of the cells are unknowns too.

        Source: Magisano, Leonetti, Garcea (2017), CMAME 313, section 3.
        """
        H, volumes = self.body.gradient(displacement), self.body.volumes
        parts: tuple[Tensor, ...]
        if volumes is None:
            response = self.material.response(green_lagrange(H) - gap)
            S = response.stress + response.product(gap)
            stress, parts = S + H @ S, (response.tangent(H),)
        else:
            stress, parts = mean_dilatation.mixed_system(self.material, H, gap, volumes)
        return self.body.nodal_forces(stress), self.body.entries(*parts)

    @torch.no_grad()
    def evaluate(self, displacement: Tensor) -> tuple[Tensor, Tensor]:
        """Return internal force (B, N, D) and min det F (B,)."""
        return self.internal_force(displacement), self.volume_ratio(displacement)

    @torch.no_grad()
    def linearise(self, displacement: Tensor, gap: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Return force (B, N, D), tangent (B, nnz) and min det C of the mixed points (B,)."""
        if gap is None:
            force, tangent = self.internal_force(displacement), self.tangent(displacement)
            return force, tangent, force.new_full(force.shape[:1], torch.inf)
        force, tangent = self.mixed_system(displacement, gap)
        strain_gap = gap.strain if isinstance(gap, MixedGap) else gap
        lowest = volume_change(2 * (self.strain(displacement) - strain_gap)).flatten(1).amin(1)
        if (volumes := self.body.volumes) is not None:
            change = volume_change(self.body.gradient(displacement))
            mean = volumes.at_points(volumes.coefficients(change) - gap.volume)
            lowest = torch.minimum(lowest, mean.flatten(1).amin(1))
        return force, tangent, 1 + lowest

    def update_strain_gap(
        self, gap: Any, length: float, update: Tensor, displacement: Tensor | None = None
    ) -> Any:
        """Return the gap after a step, see `Problem.update_strain_gap`."""
        dH, volumes = self.body.gradient(update), self.body.volumes
        wider = length**2 * dH.mT @ dH / 2
        if volumes is None or displacement is None:
            return wider if gap is None else (1 - length) * gap + wider
        volume = volume_gap(self.body.gradient(displacement), length * dH, volumes)
        if gap is None:
            return MixedGap(wider, volume)
        left = 1 - length
        return MixedGap(left * gap.strain + wider, left * gap.volume + volume)

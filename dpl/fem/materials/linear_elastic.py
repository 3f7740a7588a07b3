"""Linear elasticity of small strains, as a reference."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from dpl.fem.materials.neo_hookean import as_column
from dpl.fem.materials.saint_venant_kirchhoff import SaintVenantKirchhoff
from dpl.fem.materials.tensors import (
    dyad,
    symmetric_product,
    trace,
)


@dataclass(frozen=True)
class LinearElastic(SaintVenantKirchhoff):
    """Linear elasticity: lambda/2 (tr eps)^2 + mu eps:eps, eps = (H + H^T)/2.

    Source: Bonet, Wood (2008), eq. 6.29 at small strains. Exact where rotations are small. The
    tangent is the same for all loads: one Newton step answers a load under which det F stays above
    `Newton.keep` everywhere. Below that steps are shortened, and there is no answer where det F of
    the linear one is not above 0.
    """

    finite: ClassVar[bool] = False

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        strain = (H + H.mT) / 2
        return self.lam / 2 * trace(H).square() + self.mu * strain.square().sum((-2, -1))

    def stress(self, H: Tensor) -> Tensor:
        """Return lambda tr eps I + 2 mu eps, see `Material.stress`."""
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        return (self.lam * trace(H))[..., None, None] * eye + as_column(self.mu, 2) * (H + H.mT)

    def tangent(self, H: Tensor) -> Tensor:
        """Return Hooke's moduli, see `Material.tangent`."""
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        hooke = as_column(self.lam, 4) * dyad(eye, eye)
        hooke = hooke + 2 * as_column(self.mu, 4) * symmetric_product(eye)
        return hooke.expand(*H.shape, 3, 3)

    @property
    def has_response(self) -> bool:
        """No: its stress is no function of the Green-Lagrange strain."""
        return False

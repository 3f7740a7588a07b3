"""Linear elasticity of small strains, as a reference."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.materials.material import YoungPoissonMaterial
from dpl.fem.materials.saint_venant_kirchhoff import SaintVenantKirchhoff
from dpl.fem.materials.tensors import (
    broadcast_modulus,
    dyad,
    symmetric_product,
    trace,
)


class Hookean(InvariantBasedMaterial):
    """Linear elasticity: lambda/2 (tr eps)^2 + mu eps:eps, eps = (H + H^T)/2.

    Source: Bonet, Wood (2008), eq. 6.29 at small strains.
    """

    finite: ClassVar[bool] = False
    invariant_derivatives = staticmethod(SaintVenantKirchhoff.invariant_derivatives)

    @property
    def constants(self) -> tuple[float, ...]:
        """Return lambda and mu."""
        return self.lam, self.mu

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        strain = (H + H.mT) / 2
        return self.lam / 2 * trace(H).square() + self.mu * strain.square().sum((-2, -1))

    def stress(self, H: Tensor) -> Tensor:
        """Return lambda tr eps I + 2 mu eps, see `Material.stress`."""
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        return (self.lam * trace(H))[..., None, None] * eye + broadcast_modulus(self.mu, 2) * (
            H + H.mT
        )

    def tangent(self, H: Tensor) -> Tensor:
        """Return Hooke's moduli, see `Material.tangent`."""
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        hooke = broadcast_modulus(self.lam, 4) * dyad(eye, eye)
        hooke = hooke + 2 * broadcast_modulus(self.mu, 4) * symmetric_product(eye)
        return hooke.expand(*H.shape, 3, 3)

    @property
    def has_response(self) -> bool:
        """No: its stress is no function of the Green-Lagrange strain."""
        return False


@dataclass(frozen=True)
class LinearElastic(YoungPoissonMaterial, Hookean):
    """Linear elasticity of small strains.

    Exact where rotations are small. The tangent does not depend on the displacement: one Newton
    iteration solves any load under which det F stays above `Newton.min_detF_ratio` everywhere.
    Below that the step is shortened. There is no solution where the linear one has det F <= 0.
    """


@dataclass(frozen=True)
class LameElastic(Hookean):
    """Linear elasticity with any Lame parameters, a term of a stiffness; see `StiffnessTerms`.

    Attributes:
        shear, first: mu and lambda over Young's modulus [-]; numbers or fields.
    """

    ranged: ClassVar[tuple[str, ...]] = ("shear", "first")

    shear: float
    first: float

    @property
    def mu(self) -> float:
        """Shear modulus over Young's modulus [-]."""
        return self.shear

    @property
    def lam(self) -> float:
        """First Lame parameter over Young's modulus [-]."""
        return self.first

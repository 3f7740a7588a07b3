"""Saint Venant-Kirchhoff: linear in the Green-Lagrange strain."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.materials.material import YoungPoissonMaterial
from dpl.fem.materials.tensors import (
    green_lagrange,
    trace,
)


@dataclass(frozen=True)
class SaintVenantKirchhoff(YoungPoissonMaterial, InvariantBasedMaterial):
    """Saint Venant-Kirchhoff solid SVK: lambda/2 (tr E)^2 + mu E:E, E = (F^T F - I)/2.

    Source: Bonet, Wood (2008), eq. 6.28. It softens in compression: no answer need exist there.
    """

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        E = green_lagrange(H)
        return self.lam / 2 * trace(E).square() + self.mu * E.square().sum((-2, -1))

    @property
    def constants(self) -> tuple[float, ...]:
        """Return lambda and mu."""
        return self.lam, self.mu

    @staticmethod
    def invariant_derivatives(
        c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any
    ) -> tuple[Any, ...]:
        """See `InvariantBasedMaterial.invariant_derivatives`."""
        rest = (c[0] / 2 + c[1]) * i1
        return rest, -c[1] / 2, 0.0, c[0] / 4 + c[1] / 2, 0.0, 0.0, 0.0, 0.0, 0.0

"""Yeoh with isochoric invariants."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.materials.isochoric import isochoric_invariants, polynomial_derivatives
from dpl.fem.materials.material import check_moduli


@dataclass(frozen=True)
class YeohK2(InvariantBasedMaterial):
    """Yeoh's solid: c10 (Ib1 - 3) + c20 (Ib1 - 3)^2 + c30 (Ib1 - 3)^3 + bulk/2 (J - 1)^2.

    Source: Yeoh (1993), Rubber Chem. Technol. 66; the volumetric term is that of Abaqus.

    Attributes:
        c10, c20, c30, bulk: Moduli over E [-]. Shear modulus at rest 2 c10.
    """

    c10: float
    c20: float
    c30: float
    bulk: float

    def check_constants(self) -> None:
        """See `Material.check_constants`: the body must resist shear and compression."""
        check_moduli("2 c10", 2 * self.c10, self.bulk, vars(self).values())

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        i1, _, j = isochoric_invariants(H)
        return i1 * (self.c10 + i1 * (self.c20 + i1 * self.c30)) + self.bulk / 2 * j.square()

    @property
    def constants(self) -> tuple[float, ...]:
        """Return c10, c20, c30, 0 and bulk."""
        return self.c10, self.c20, self.c30, 0.0, self.bulk

    @staticmethod
    def invariant_derivatives(
        c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any
    ) -> tuple[Any, ...]:
        """See `InvariantBasedMaterial.invariant_derivatives`."""
        return polynomial_derivatives(
            c, i1, i2, m1, c[4] * j * (1 + j), c[4] * (1 + j) * (1 + 2 * j)
        )

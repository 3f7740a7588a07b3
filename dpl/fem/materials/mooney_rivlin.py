"""Mooney-Rivlin with isochoric invariants."""

from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor

from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.materials.isochoric import isochoric_invariants, polynomial_derivatives
from dpl.fem.materials.material import check_moduli
from dpl.fem.materials.parameters import Constant


@dataclass(frozen=True)
class MooneyRivlinK2(InvariantBasedMaterial):
    """Mooney-Rivlin solid: c10 (Ib1 - 3) + c01 (Ib2 - 3) + bulk/2 (J - 1)^2.

    Ib1 = J^(-2/3) I1 and Ib2 = J^(-4/3) I2. Shear modulus at rest 2 (c10 + c01).

    Source: Rivlin (1948); the volumetric term is that of Abaqus (D1 = 2/bulk).

    Attributes:
        c10, c01, bulk: Moduli over E [-]; numbers, ranges [low, high] or fields.
    """

    ranged: ClassVar[tuple[str, ...]] = ("c10", "c01", "bulk")

    c10: Constant
    c01: Constant
    bulk: Constant

    def check_constants(self) -> None:
        """See `Material.check_constants`: the body must resist shear and compression."""
        c10, *_, c01, bulk = self.constants
        check_moduli("2 (c10 + c01)", 2 * (c10 + c01), bulk, self.constants)

    @property
    def mu(self) -> float:
        """Shear modulus at rest over Young's modulus [-]."""
        return 2 * (self._number("c10") + self._number("c01"))

    @property
    def lam(self) -> float:
        """First Lame parameter at rest over Young's modulus [-]."""
        return self._number("bulk") - 2 / 3 * self.mu

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        i1, i2, j = isochoric_invariants(H)
        c10, *_, c01, bulk = self.constants
        return c10 * i1 + c01 * i2 + bulk / 2 * j.square()

    @property
    def constants(self) -> tuple[float, ...]:
        """Return c10, 0, 0, c01 and bulk."""
        c10, c01, bulk = map(self._number, ("c10", "c01", "bulk"))
        return c10, 0.0, 0.0, c01, bulk

    @staticmethod
    def invariant_derivatives(
        c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any
    ) -> tuple[Any, ...]:
        """See `InvariantBasedMaterial.invariant_derivatives`."""
        return polynomial_derivatives(
            c, i1, i2, m1, c[4] * j * (1 + j), c[4] * (1 + j) * (1 + 2 * j)
        )

"""Yeoh with isochoric invariants."""

from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor

from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.materials.isochoric import isochoric_invariants, polynomial_derivatives
from dpl.fem.materials.material import check_moduli
from dpl.fem.materials.parameters import Constant


@dataclass(frozen=True)
class YeohK2(InvariantBasedMaterial):
    """Yeoh's solid: c10 (Ib1 - 3) + c20 (Ib1 - 3)^2 + c30 (Ib1 - 3)^3 + bulk/2 (J - 1)^2.

    Source: Yeoh (1993), Rubber Chem. Technol. 66; the volumetric term is that of Abaqus.

    Attributes:
        c10, c20, c30, bulk: Moduli over E [-]; numbers, ranges [low, high] or fields. The shear
            modulus at rest is 2 c10.
    """

    ranged: ClassVar[tuple[str, ...]] = ("c10", "c20", "c30", "bulk")

    c10: Constant
    c20: Constant
    c30: Constant
    bulk: Constant

    def check_constants(self) -> None:
        """See `Material.check_constants`: the body must resist shear and compression."""
        c10, *_, bulk = self.constants
        check_moduli("2 c10", 2 * c10, bulk, self.constants)

    @property
    def mu(self) -> float:
        """Shear modulus at rest over Young's modulus [-]."""
        return 2 * self._number("c10")

    @property
    def lam(self) -> float:
        """First Lame parameter at rest over Young's modulus [-]."""
        return self._number("bulk") - 2 / 3 * self.mu

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        i1, _, j = isochoric_invariants(H)
        c10, c20, c30, _, bulk = self.constants
        return i1 * (c10 + i1 * (c20 + i1 * c30)) + bulk / 2 * j.square()

    @property
    def constants(self) -> tuple[float, ...]:
        """Return c10, c20, c30, 0 and bulk."""
        c10, c20, c30, bulk = map(self._number, ("c10", "c20", "c30", "bulk"))
        return c10, c20, c30, 0.0, bulk

    @staticmethod
    def invariant_derivatives(
        c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any
    ) -> tuple[Any, ...]:
        """See `InvariantBasedMaterial.invariant_derivatives`."""
        return polynomial_derivatives(
            c, i1, i2, m1, c[4] * j * (1 + j), c[4] * (1 + j) * (1 + 2 * j)
        )

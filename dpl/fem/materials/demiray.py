"""Demiray's exponential law with the isochoric first invariant."""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from dpl.fem.materials.arithmetic import exp
from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.materials.isochoric import isochoric_derivatives, isochoric_invariants
from dpl.fem.materials.material import check_moduli
from dpl.fem.materials.parameters import Constant


@dataclass(frozen=True)
class DemirayK2(InvariantBasedMaterial):
    """Demiray's solid: a/(2 b) (exp(b (Ib1 - 3)) - 1) + bulk/2 (J - 1)^2.

    Ib1 = J^(-2/3) I1. Shear modulus at rest a. It is the isotropic part of `HolzapfelOgdenFibres`.

    Source: Demiray (1972), J. Biomech. 5; in this form Holzapfel, Ogden (2009), Phil. Trans. R.
    Soc. A 367. The volumetric term is that of Abaqus.

    Attributes:
        a: Shear modulus over E [-].
        b: Exponent [-].
        bulk: Bulk modulus over E [-].
    """

    ranged: ClassVar[tuple[str, ...]] = ("a", "b", "bulk")

    a: Constant
    b: Constant
    bulk: Constant

    def check_constants(self) -> None:
        """See `Material.check_constants`."""
        check_moduli("a", self.a, self.bulk, (self.a, self.b, self.bulk))
        if not self.b > 0:
            raise ValueError(f"b = {self.b} must be above 0")

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        i1, _, j = isochoric_invariants(H)
        half, b, bulk = self.constants
        return half / b * torch.expm1(b * i1) + bulk / 2 * j.square()

    @property
    def constants(self) -> tuple[float, ...]:
        """Return a/2, b and bulk."""
        return self._number("a") / 2, self._number("b"), self._number("bulk")

    @property
    def mu(self) -> float:
        """Shear modulus at rest over Young's modulus [-]."""
        return self.constants[0] * 2

    @property
    def lam(self) -> float:
        """First Lame parameter at rest over Young's modulus [-]."""
        return self._number("bulk") - 2 / 3 * self.mu

    @staticmethod
    def invariant_derivatives(
        c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any
    ) -> tuple[Any, ...]:
        """See `InvariantBasedMaterial.invariant_derivatives`."""
        f1 = c[0] * exp(c[1] * ((1 + m1) * i1 + 3 * m1))
        return isochoric_derivatives(
            f1, c[1] * f1, 0.0, i1, i2, m1, c[2] * j * (1 + j), c[2] * (1 + j) * (1 + 2 * j)
        )

"""Demiray's exponential law with the isochoric first invariant."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dpl.fem.materials.arithmetic import exp
from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.materials.isochoric import isochoric_derivatives, isochoric_invariants
from dpl.fem.materials.material import check_moduli


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

    a: float
    b: float
    bulk: float

    def check_constants(self) -> None:
        """See `Material.check_constants`."""
        check_moduli("a", self.a, self.bulk, (self.a, self.b, self.bulk))
        if not self.b > 0:
            raise ValueError(f"b = {self.b} must be above 0")

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        i1, _, j = isochoric_invariants(H)
        return self.a / (2 * self.b) * torch.expm1(self.b * i1) + self.bulk / 2 * j.square()

    @property
    def constants(self) -> tuple[float, ...]:
        """Return a/2, b and bulk."""
        return self.a / 2, self.b, self.bulk

    @staticmethod
    def invariant_derivatives(
        c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any
    ) -> tuple[Any, ...]:
        """See `InvariantBasedMaterial.invariant_derivatives`."""
        f1 = c[0] * exp(c[1] * ((1 + m1) * i1 + 3 * m1))
        return isochoric_derivatives(
            f1, c[1] * f1, 0.0, i1, i2, m1, c[2] * j * (1 + j), c[2] * (1 + j) * (1 + 2 * j)
        )

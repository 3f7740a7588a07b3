"""Energies of the volume alone: terms of other laws, and matrix of laws of fibres."""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from dpl.fem.materials.invariant_based import Derivatives, InvariantBasedMaterial
from dpl.fem.materials.parameters import Constant, Scalable
from dpl.fem.materials.tensors import volume_change
from dpl.fem.options import option


def k2_derivatives(bulk: Any, j: Any) -> tuple[Any, Any]:
    """Return J U' and J (J U')' of U = bulk/2 (J - 1)^2 at J = 1 + j."""
    return bulk * j * (1 + j), bulk * (1 + j) * (1 + 2 * j)


def k4_derivatives(bulk: Any, j: Any) -> tuple[Any, Any]:
    """Return J U' and J (J U')' of U = bulk/4 (J^2 - 1 - 2 ln J) at J = 1 + j."""
    return bulk / 2 * j * (2 + j), bulk * (1 + j) * (1 + j)


@dataclass(frozen=True)
class VolumetricK2(InvariantBasedMaterial, Scalable):
    """Volumetric energy bulk/2 (J - 1)^2, which needs the fibres of `FibreReinforced`.

    Source: The volumetric term of Abaqus (D1 = 2/bulk).

    Attributes:
        bulk: Bulk modulus, see `Scalable`.
    """

    ranged: ClassVar[tuple[str, ...]] = ("bulk",)
    dimensional: ClassVar[tuple[str, ...]] = ("bulk",)

    bulk: Constant = option("", above=0.0)

    def energy(self, H: Tensor) -> Tensor:
        return self.value("bulk") / 2 * volume_change(H).square()

    @property
    def mu(self) -> Tensor:
        return torch.zeros((), dtype=torch.float64)

    @property
    def lam(self) -> Tensor:
        return self.value("bulk")

    @staticmethod
    def invariant_derivatives(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> Derivatives:
        p, pJ = k2_derivatives(c[0], j)
        return p, 0.0, p, 0.0, 0.0, 0.0, 0.0, 0.0, pJ


@dataclass(frozen=True)
class VolumetricK4(VolumetricK2):
    """Volumetric energy bulk/4 (J^2 - 1 - 2 ln J); see `VolumetricK2`.

    Source: Simo, Taylor (1991), CMAME 85, eq. 2.5.
    """

    def energy(self, H: Tensor) -> Tensor:
        j = volume_change(H)
        return self.value("bulk") / 4 * (j * (2 + j) - 2 * torch.log1p(j))

    @staticmethod
    def invariant_derivatives(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> Derivatives:
        p, pJ = k4_derivatives(c[0], j)
        return p, 0.0, p, 0.0, 0.0, 0.0, 0.0, 0.0, pJ

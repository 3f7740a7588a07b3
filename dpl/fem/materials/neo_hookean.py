"""Neo-Hookean laws. The end of a name says which volumetric term the law has."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dpl.fem.materials.invariant_based import Derivatives, InvariantBasedMaterial
from dpl.fem.materials.isochoric import (
    PolynomialMaterial,
    isochoric_invariants,
    k4_derivatives,
    polynomial_derivatives,
)
from dpl.fem.materials.material import YoungPoissonMaterial
from dpl.fem.materials.tensors import trace, volume_change


@dataclass(frozen=True)
class NeoHookeanLn(YoungPoissonMaterial, InvariantBasedMaterial):
    """Compressible neo-Hookean solid NH-ln: mu/2 (I1 - 3 - 2 ln J) + lambda/2 (ln J)^2.

    Source: Bonet, Wood (2008), eq. 6.27. Infinite at J = 0; undefined (NaN) below.
    """

    def energy(self, H: Tensor) -> Tensor:
        log_J = torch.log1p(volume_change(H))
        I1_minus_3 = 2 * trace(H) + H.square().sum((-2, -1))
        return self.mu / 2 * (I1_minus_3 - 2 * log_J) + self.lam / 2 * log_J.square()

    @property
    def constants(self) -> tuple[Tensor, ...]:
        return self.lam, self.mu

    @staticmethod
    def invariant_derivatives(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> Derivatives:
        rest = c[0] * log_j
        return rest, 0.0, rest - c[1], 0.0, 0.0, 0.0, 0.0, 0.0, c[0]


@dataclass(frozen=True)
class NeoHookeanIsoK2(YoungPoissonMaterial, PolynomialMaterial):
    """Neo-Hookean solid NHiso-k2: mu/2 (J^(-2/3) I1 - 3) + kappa/2 (J - 1)^2.

    Source: Simo, Hughes (1998), section 9.2; the volumetric term is that of Abaqus (D1 = 2/kappa).
    """

    @property
    def constants(self) -> tuple[Tensor, ...]:
        half = self.mu / 2
        return half, 0 * half, 0 * half, 0 * half, self.bulk_modulus


@dataclass(frozen=True)
class NeoHookeanIsoK4(NeoHookeanIsoK2):
    """Neo-Hookean solid NHiso-k4: mu/2 (J^(-2/3) I1 - 3) + kappa/4 (J^2 - 1 - 2 ln J).

    Source: Simo, Taylor (1991), CMAME 85, eq. 2.5; the law of deal.II's step-44.
    """

    def energy(self, H: Tensor) -> Tensor:
        i1, _, j = isochoric_invariants(H)
        return self.mu / 2 * i1 + self.bulk_modulus / 4 * (j * (2 + j) - 2 * torch.log1p(j))

    @staticmethod
    def invariant_derivatives(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> Derivatives:
        return polynomial_derivatives(c, i1, i2, m1, k4_derivatives(c[4], j))


@dataclass(frozen=True)
class StableNeoHookean(YoungPoissonMaterial, InvariantBasedMaterial):
    """Stable neo-Hookean solid: m/2 (I1 - 3) + l/2 (J - a)^2 - m/2 ln(I1 + 1).

    With m = 4 mu/3, l = lambda + 5 mu/6 and a = 1 + 3 m/(4 l). The energy is finite for any F,
    inverted or not (a body may rest inverted), the stress for any F that is not singular. The
    energy at rest is not zero.

    Source: Smith, de Goes, Kim (2018), ACM TOG 37(2), eq. 14.
    """

    def energy(self, H: Tensor) -> Tensor:
        m, stiffness = self.constants
        i1 = 2 * trace(H) + H.square().sum((-2, -1))
        volume = (volume_change(H) - 3 * m / (4 * stiffness)).square()
        return m / 2 * (i1 - torch.log(4 + i1)) + stiffness / 2 * volume

    @property
    def constants(self) -> tuple[Tensor, ...]:
        """Return m and l."""
        return 4 / 3 * self.mu, self.lam + 5 / 6 * self.mu

    @staticmethod
    def invariant_derivatives(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> Derivatives:
        near = 1 / (4 + i1)
        J = 1 + j
        volume = c[1] * j * J - 3 / 4 * c[0] * j
        rest = volume + c[0] / 4 * i1 * near
        p = volume - 3 / 4 * c[0]
        W11 = c[0] / 2 * near * near
        return rest, 0.0, p, W11, 0.0, 0.0, 0.0, 0.0, J * (c[1] * (1 + 2 * j) - 3 / 4 * c[0])

"""The laws, their moduli over Young's modulus; names say the volumetric term."""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from dpl.fem.law import Hookean, Isotropic, Material, Response, check_moduli
from dpl.fem.ogden import OgdenK2
from dpl.fem.tensors import (
    dyad,
    green_lagrange,
    invariants,
    symmetric_product,
    trace,
    volume_change,
)

__all__ = [
    "Hookean",
    "Isotropic",
    "LinearElastic",
    "Material",
    "MooneyRivlinK2",
    "NeoHookeanIsoK2",
    "NeoHookeanIsoK4",
    "NeoHookeanLn",
    "OgdenK2",
    "Response",
    "SaintVenantKirchhoff",
    "StableNeoHookean",
    "YeohK2",
]


@dataclass(frozen=True)
class SaintVenantKirchhoff(Hookean, Isotropic):
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
    def slopes(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> tuple[Any, ...]:
        """Return the slopes, see `Isotropic.slopes`."""
        rest = (c[0] / 2 + c[1]) * i1
        return rest, -c[1] / 2, 0.0, c[0] / 4 + c[1] / 2, 0.0, 0.0, 0.0, 0.0, 0.0


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
        return (self.lam * trace(H))[..., None, None] * eye + beside(self.mu, 2) * (H + H.mT)

    def tangent(self, H: Tensor) -> Tensor:
        """Return Hooke's moduli, see `Material.tangent`."""
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        hooke = beside(self.lam, 4) * dyad(eye, eye)
        hooke = hooke + 2 * beside(self.mu, 4) * symmetric_product(eye)
        return hooke.expand(*H.shape, 3, 3)

    @property
    def has_response(self) -> bool:
        """No: its stress is no function of the Green-Lagrange strain."""
        return False


@dataclass(frozen=True)
class NeoHookeanLn(Hookean, Isotropic):
    """Compressible neo-Hookean solid NH-ln: mu/2 (I1 - 3 - 2 ln J) + lambda/2 (ln J)^2.

    Source: Bonet, Wood (2008), eq. 6.27. Infinite at J = 0; undefined (NaN) below.
    """

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        log_J = torch.log1p(volume_change(H))
        I1_minus_3 = 2 * trace(H) + H.square().sum((-2, -1))
        return self.mu / 2 * (I1_minus_3 - 2 * log_J) + self.lam / 2 * log_J.square()

    @property
    def constants(self) -> tuple[float, ...]:
        """Return lambda and mu."""
        return self.lam, self.mu

    @staticmethod
    def slopes(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> tuple[Any, ...]:
        """Return the slopes, see `Isotropic.slopes`."""
        rest = c[0] * log_j
        return rest, 0.0, rest - c[1], 0.0, 0.0, 0.0, 0.0, 0.0, c[0]


@dataclass(frozen=True)
class NeoHookeanIsoK2(Hookean, Isotropic):
    """Neo-Hookean solid NHiso-k2: mu/2 (J^(-2/3) I1 - 3) + kappa/2 (J - 1)^2.

    Source: Simo, Hughes (1998), section 9.2; the volumetric term is that of Abaqus (D1 = 2/kappa).
    """

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        i1, _, j = _isochoric(H)
        return self.mu / 2 * i1 + self.bulk / 2 * j.square()

    @property
    def constants(self) -> tuple[float, ...]:
        """Return mu/2, 0, 0, 0 and kappa."""
        return self.mu / 2, 0.0, 0.0, 0.0, self.bulk

    @staticmethod
    def slopes(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> tuple[Any, ...]:
        """Return the slopes, see `Isotropic.slopes`."""
        return polynomial_slopes(c, i1, i2, m1, c[4] * j * (1 + j), c[4] * (1 + j) * (1 + 2 * j))


@dataclass(frozen=True)
class NeoHookeanIsoK4(NeoHookeanIsoK2):
    """Neo-Hookean solid NHiso-k4: mu/2 (J^(-2/3) I1 - 3) + kappa/4 (J^2 - 1 - 2 ln J).

    Source: Simo, Taylor (1991), CMAME 85, eq. 2.5; the law of deal.II's step-44.
    """

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        i1, _, j = _isochoric(H)
        return self.mu / 2 * i1 + self.bulk / 4 * (j * (2 + j) - 2 * torch.log1p(j))

    @staticmethod
    def slopes(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> tuple[Any, ...]:
        """Return the slopes, see `Isotropic.slopes`."""
        return polynomial_slopes(c, i1, i2, m1, c[4] / 2 * j * (2 + j), c[4] * (1 + j) * (1 + j))


@dataclass(frozen=True)
class StableNeoHookean(Hookean, Isotropic):
    """Stable neo-Hookean solid: m/2 (I1 - 3) + l/2 (J - a)^2 - m/2 ln(I1 + 1).

    With m = 4 mu/3, l = lambda + 5 mu/6 and a = 1 + 3 m/(4 l). The energy is finite for any F,
    inverted or not (a body may rest inverted), the stress for any F that is not singular. The
    energy at rest is not zero.

    Source: Smith, de Goes, Kim (2018), ACM TOG 37(2), eq. 14.
    """

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        m, stiffness = self.constants
        i1 = 2 * trace(H) + H.square().sum((-2, -1))
        volume = (volume_change(H) - 3 * m / (4 * stiffness)).square()
        return m / 2 * (i1 - torch.log(4 + i1)) + stiffness / 2 * volume

    @property
    def constants(self) -> tuple[float, ...]:
        """Return m and l."""
        return 4 / 3 * self.mu, self.lam + 5 / 6 * self.mu

    @staticmethod
    def slopes(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> tuple[Any, ...]:
        """Return the slopes, see `Isotropic.slopes`."""
        near = 1 / (4 + i1)
        J = 1 + j
        volume = c[1] * j * J - 3 / 4 * c[0] * j
        rest = volume + c[0] / 4 * i1 * near
        p = volume - 3 / 4 * c[0]
        W11 = c[0] / 2 * near * near
        return rest, 0.0, p, W11, 0.0, 0.0, 0.0, 0.0, J * (c[1] * (1 + 2 * j) - 3 / 4 * c[0])


@dataclass(frozen=True)
class MooneyRivlinK2(Isotropic):
    """Mooney-Rivlin solid: c10 (Ib1 - 3) + c01 (Ib2 - 3) + bulk/2 (J - 1)^2.

    Ib1 = J^(-2/3) I1 and Ib2 = J^(-4/3) I2. Shear modulus at rest 2 (c10 + c01).

    Source: Rivlin (1948); the volumetric term is that of Abaqus (D1 = 2/bulk).

    Attributes:
        c10, c01, bulk: Moduli over E [-].
    """

    c10: float
    c01: float
    bulk: float

    def __post_init__(self) -> None:
        """Check the range.

        Raises:
            ValueError: The body would not resist shear or compression.
        """
        check_moduli("2 (c10 + c01)", 2 * (self.c10 + self.c01), self.bulk, vars(self).values())

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        i1, i2, j = _isochoric(H)
        return self.c10 * i1 + self.c01 * i2 + self.bulk / 2 * j.square()

    @property
    def constants(self) -> tuple[float, ...]:
        """Return c10, 0, 0, c01 and bulk."""
        return self.c10, 0.0, 0.0, self.c01, self.bulk

    @staticmethod
    def slopes(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> tuple[Any, ...]:
        """Return the slopes, see `Isotropic.slopes`."""
        return polynomial_slopes(c, i1, i2, m1, c[4] * j * (1 + j), c[4] * (1 + j) * (1 + 2 * j))


@dataclass(frozen=True)
class YeohK2(Isotropic):
    """Yeoh's solid: c10 (Ib1 - 3) + c20 (Ib1 - 3)^2 + c30 (Ib1 - 3)^3 + bulk/2 (J - 1)^2.

    Source: Yeoh (1993), Rubber Chem. Technol. 66; the volumetric term is that of Abaqus.

    Attributes:
        c10, c20, c30, bulk: Moduli over E [-]. Shear modulus at rest 2 c10.
    """

    c10: float
    c20: float
    c30: float
    bulk: float

    def __post_init__(self) -> None:
        """Check the range.

        Raises:
            ValueError: The body would not resist shear or compression.
        """
        check_moduli("2 c10", 2 * self.c10, self.bulk, vars(self).values())

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        i1, _, j = _isochoric(H)
        return i1 * (self.c10 + i1 * (self.c20 + i1 * self.c30)) + self.bulk / 2 * j.square()

    @property
    def constants(self) -> tuple[float, ...]:
        """Return c10, c20, c30, 0 and bulk."""
        return self.c10, self.c20, self.c30, 0.0, self.bulk

    @staticmethod
    def slopes(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> tuple[Any, ...]:
        """Return the slopes, see `Isotropic.slopes`."""
        return polynomial_slopes(c, i1, i2, m1, c[4] * j * (1 + j), c[4] * (1 + j) * (1 + 2 * j))


def beside(modulus: float, axes: int) -> Any:
    """Return a modulus as a factor on tensors with so many components at each point."""
    return modulus[(..., *[None] * axes)] if isinstance(modulus, Tensor) else modulus


def polynomial_slopes(c: Any, i1: Any, i2: Any, m1: Any, q: Any, qJ: Any) -> tuple[Any, ...]:
    """Return the slopes of c0 x + c1 x^2 + c2 x^3 + c3 y + U(J), x = Ib1 - 3, y = Ib2 - 3.

    Args:
        c: Moduli.
        i1, i2, m1: As in `Isotropic.slopes`.
        q, qJ: J U' and J (J U')'.
    """
    m = 1 + m1
    x = m * i1 + 3 * m1
    f1, f11 = c[0] + x * (2 * c[1] + 3 * c[2] * x), 2 * c[1] + 6 * c[2] * x
    I1, I2, f2 = x + 3, m * m * (3 + i2), c[3]  # of the isochoric part
    W2, W22 = f2 * m * m, 0.0
    rest = q - 2 / 3 * f1 * m * i1 - 4 / 3 * f2 * m * m * i2
    p = q - 2 / 3 * f1 * I1 - 4 / 3 * f2 * I2
    W1J = -2 / 3 * m * (f1 + f11 * I1)
    pJ = qJ + 4 / 9 * I1 * (f1 + f11 * I1) + 16 / 9 * f2 * I2
    return rest, W2, p, f11 * m * m, 0.0, W22, W1J, -4 / 3 * W2, pJ


def _isochoric(H: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return Ib1 - 3, Ib2 - 3 and J - 1, (...,) [-], of H (..., 3, 3)."""
    e, j = 2 * green_lagrange(H), volume_change(H)
    i1, second, _ = invariants(e)
    log_j = torch.log1p(j)
    m, n = torch.exp(-2 / 3 * log_j), torch.exp(-4 / 3 * log_j)
    i2 = 2 * i1 + second
    return (
        m * i1 + 3 * torch.expm1(-2 / 3 * log_j),
        n * i2 + 3 * torch.expm1(-4 / 3 * log_j),
        j,
    )

"""Laws of the isochoric invariants Ib1 = J^(-2/3) I1 and Ib2 = J^(-4/3) I2 and of the volume.

Laws of the volume alone are the matrix of laws of fibres.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from dpl.fem.materials.arithmetic import exp
from dpl.fem.materials.invariant_based import Derivatives, InvariantBasedMaterial
from dpl.fem.materials.material import BulkOrPoisson
from dpl.fem.materials.parameters import Constant, Scalable
from dpl.fem.materials.tensors import green_lagrange, invariants, volume_change
from dpl.fem.options import option


def k2_derivatives(bulk: Any, j: Any) -> tuple[Any, Any]:
    """Return J U' and J (J U')' of U = bulk/2 (J - 1)^2 at J = 1 + j."""
    return bulk * j * (1 + j), bulk * (1 + j) * (1 + 2 * j)


def k4_derivatives(bulk: Any, j: Any) -> tuple[Any, Any]:
    """Return J U' and J (J U')' of U = bulk/4 (J^2 - 1 - 2 ln J) at J = 1 + j."""
    return bulk / 2 * j * (2 + j), bulk * (1 + j) * (1 + j)


def isochoric_derivatives(
    f1: Any, f11: Any, f2: Any, i1: Any, i2: Any, m1: Any, volumetric: tuple[Any, Any]
) -> Derivatives:
    """Return `invariant_derivatives` of f(x) + f2 y + U(J), x = Ib1 - 3 and y = Ib2 - 3.

    f1 and f11 are f' and f'', and `volumetric` is J U' and J (J U')'.
    """
    q, qJ = volumetric
    m = 1 + m1
    x = m * i1 + 3 * m1
    I1, I2 = x + 3, m * m * (3 + i2)  # of the isochoric part
    W2, W22 = f2 * m * m, 0.0
    rest = q - 2 / 3 * f1 * m * i1 - 4 / 3 * f2 * m * m * i2
    p = q - 2 / 3 * f1 * I1 - 4 / 3 * f2 * I2
    W1J = -2 / 3 * m * (f1 + f11 * I1)
    pJ = qJ + 4 / 9 * I1 * (f1 + f11 * I1) + 16 / 9 * f2 * I2
    return rest, W2, p, f11 * m * m, 0.0, W22, W1J, -4 / 3 * W2, pJ


def polynomial_derivatives(
    c: Any, i1: Any, i2: Any, m1: Any, volumetric: tuple[Any, Any]
) -> Derivatives:
    """Return `isochoric_derivatives` of c0 x + c1 x^2 + c2 x^3 + c3 y + U(J)."""
    x = (1 + m1) * i1 + 3 * m1
    f1, f11 = c[0] + x * (2 * c[1] + 3 * c[2] * x), 2 * c[1] + 6 * c[2] * x
    return isochoric_derivatives(f1, f11, c[3], i1, i2, m1, volumetric)


def isochoric_invariants(H: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return Ib1 - 3, Ib2 - 3 and J - 1, (...,) [-], of H (..., 3, 3)."""
    e, j = 2 * green_lagrange(H), volume_change(H)
    i1, second, _ = invariants(e)
    log_j = torch.log1p(j)
    m, n = torch.exp(-2 / 3 * log_j), torch.exp(-4 / 3 * log_j)
    i2 = 2 * i1 + second
    x, y = m * i1 + 3 * torch.expm1(-2 / 3 * log_j), n * i2 + 3 * torch.expm1(-4 / 3 * log_j)
    return x, y, j


class PolynomialMaterial(InvariantBasedMaterial):
    """Law c10 x + c20 x^2 + c30 x^3 + c01 y + bulk/2 (J - 1)^2, x = Ib1 - 3 and y = Ib2 - 3.

    Its `constants` are c10, c20, c30, c01 and bulk over E [-]. The volumetric term is that of
    Abaqus (D1 = 2/bulk).
    """

    def energy(self, H: Tensor) -> Tensor:
        i1, i2, j = isochoric_invariants(H)
        c10, c20, c30, c01, bulk = self.constants
        return i1 * (c10 + i1 * (c20 + i1 * c30)) + c01 * i2 + bulk / 2 * j.square()

    @staticmethod
    def invariant_derivatives(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> Derivatives:
        return polynomial_derivatives(c, i1, i2, m1, k2_derivatives(c[4], j))


class PolynomialK2(BulkOrPoisson, PolynomialMaterial):
    """Law in which some of c10, c20, c30 and c01 are constants, and the others are zero."""

    @property
    def _moduli(self) -> tuple[Tensor, ...]:
        """Return c10, c20, c30 and c01."""
        names, zero = ("c10", "c20", "c30", "c01"), 0 * self.value("c10")
        return tuple(self.value(name) if name in self.ranged else zero for name in names)

    @property
    def mu(self) -> Tensor:
        c10, _, _, c01 = self._moduli
        return 2 * (c10 + c01)

    @property
    def constants(self) -> tuple[Tensor, ...]:
        return *self._moduli, self.bulk_modulus


@dataclass(frozen=True)
class MooneyRivlinK2(PolynomialK2):
    """Mooney-Rivlin solid: c10 (Ib1 - 3) + c01 (Ib2 - 3) + bulk/2 (J - 1)^2.

    Source: Rivlin (1948).

    Attributes:
        c10, c01, bulk: Moduli in one unit; numbers, ranges [low, high] or fields. The shear
            modulus at rest is 2 (c10 + c01).
        poisson: Poisson's ratio at rest [-], in place of `bulk`.
    """

    ranged: ClassVar[tuple[str, ...]] = ("c10", "c01", "bulk", "poisson")
    dimensional: ClassVar[tuple[str, ...]] = ("c10", "c01", "bulk")

    c10: Constant = option("")
    c01: Constant = option("")
    bulk: Constant | None = option("", default=None, above=0.0)
    poisson: Constant | None = option("", default=None, above=-1.0, below=0.5, optional=True)


@dataclass(frozen=True)
class YeohK2(PolynomialK2):
    """Yeoh's solid: c10 (Ib1 - 3) + c20 (Ib1 - 3)^2 + c30 (Ib1 - 3)^3 + bulk/2 (J - 1)^2.

    Source: Yeoh (1993), Rubber Chem. Technol. 66.

    Attributes:
        c10, c20, c30, bulk: Moduli in one unit; numbers, ranges [low, high] or fields. The shear
            modulus at rest is 2 c10.
        poisson: Poisson's ratio at rest [-], in place of `bulk`.
    """

    ranged: ClassVar[tuple[str, ...]] = ("c10", "c20", "c30", "bulk", "poisson")
    dimensional: ClassVar[tuple[str, ...]] = ("c10", "c20", "c30", "bulk")

    c10: Constant = option("")
    c20: Constant = option("")
    c30: Constant = option("")
    bulk: Constant | None = option("", default=None, above=0.0)
    poisson: Constant | None = option("", default=None, above=-1.0, below=0.5, optional=True)


@dataclass(frozen=True)
class DemirayK2(BulkOrPoisson, InvariantBasedMaterial):
    """Demiray's solid: a/(2 b) (exp(b (Ib1 - 3)) - 1) + bulk/2 (J - 1)^2.

    Shear modulus at rest a. It is the isotropic part of `HolzapfelOgdenFibres`.

    Source: Demiray (1972), J. Biomech. 5; in this form Holzapfel, Ogden (2009), Phil. Trans. R.
    Soc. A 367. The volumetric term is that of Abaqus.

    Attributes:
        a: Shear modulus, in the unit of `bulk`.
        b: Exponent [-].
        bulk: Bulk modulus.
        poisson: Poisson's ratio at rest [-], in place of `bulk`.
    """

    ranged: ClassVar[tuple[str, ...]] = ("a", "b", "bulk", "poisson")
    dimensional: ClassVar[tuple[str, ...]] = ("a", "bulk")

    a: Constant = option("", above=0.0)
    b: Constant = option("", above=0.0)
    bulk: Constant | None = option("", default=None, above=0.0)
    poisson: Constant | None = option("", default=None, above=-1.0, below=0.5, optional=True)

    def energy(self, H: Tensor) -> Tensor:
        i1, _, j = isochoric_invariants(H)
        half, b, bulk = self.constants
        return half / b * torch.expm1(b * i1) + bulk / 2 * j.square()

    @property
    def constants(self) -> tuple[Tensor, ...]:
        """Return a/2, b and bulk."""
        return self.value("a") / 2, self.value("b"), self.bulk_modulus

    @property
    def mu(self) -> Tensor:
        return self.value("a")

    @staticmethod
    def invariant_derivatives(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> Derivatives:
        f1 = c[0] * exp(c[1] * ((1 + m1) * i1 + 3 * m1))
        return isochoric_derivatives(f1, c[1] * f1, 0.0, i1, i2, m1, k2_derivatives(c[2], j))


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

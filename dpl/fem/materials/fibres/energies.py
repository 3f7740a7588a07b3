"""Strain energies of fibres: functions of the strain in the frame of the fibres.

The frame has the axes f (fibre), s (sheet) and n (normal), numbered 1, 2, 3. The strain is
e = C - I = 2 E in this frame; symmetric tensors have the components 11, 22, 33, 12, 23, 13 in this
order.
"""

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from dpl.fem.materials.arithmetic import exp, positive_part, step
from dpl.fem.materials.linear_elastic import linear_law
from dpl.fem.materials.parameters import Constant, Parametrised, Scalable
from dpl.fem.options import option

COMPONENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))  # rows and columns, in their order


class FibreEnergy(Parametrised):
    """Energy of fibres as a function of the local strain, with its derivatives.

    The derivatives are plain arithmetic on numbers of any kind, as those of
    `InvariantBasedMaterial`: tensors, or SIMD vectors in compiled loops. Energies depend on the
    full strain and not on its isochoric part: with the isochoric part, fibres would not resist a
    change of volume, and a sphere under hydrostatic tension would stay a sphere.

    Source: Sansour (2008), Eur. J. Mech. A 27; Nolan, Gower, Destrade, Ogden, McGarry (2014),
    J. Mech. Behav. Biomed. Mater. 39.
    """

    def energy(self, e: Tensor) -> Tensor:
        """Return the energy density over E, (...,) [-], of e = C - I (..., 3, 3) [-]."""
        raise NotImplementedError

    def compressible(self) -> Self:
        """Return the energy itself; the matrix around fibres decides Poisson's ratio."""
        return self

    @property
    def moduli_at_rest(self) -> tuple[Tensor, ...]:
        """The 21 moduli of `strain_derivatives` at rest [-]."""
        rest = (torch.zeros((), dtype=torch.float64),) * 6
        return as_tensors(self.strain_derivatives(self.constants, rest)[1], rest)

    @staticmethod
    def strain_derivatives(c: Any, e: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Return stress and moduli at a strain.

        Args:
            c: `constants`.
            e: Components 11, 22, 33, 12, 23, 13 of C - I.

        Returns:
            The six components of S = 2 dW/de, and the 21 moduli dS/dE in the upper triangle of the
            matrix of these components, row by row; a modulus D_ijkl is that of the tensors, with
            no factor 2 for shear. Terms that vanish are 0.0.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Guccione(FibreEnergy, Scalable):
    """Fung-type energy c/2 (exp(Q) - 1), transversely isotropic.

    Q = bf E11^2 + bt (E22^2 + E33^2 + 2 E23^2) + 2 bfs (E12^2 + E13^2).

    Source: Guccione, McCulloch, Waldman (1991), J. Biomech. Eng. 113.

    Attributes:
        c: Modulus over E [-].
        bf, bt, bfs: Exponents along the fibre, across it and of shear between the two [-].
    """

    ranged: ClassVar[tuple[str, ...]] = ("c", "bf", "bt", "bfs")
    dimensional: ClassVar[tuple[str, ...]] = ("c",)

    c: Constant = option("", above=0.0)
    bf: Constant = option("", above=0.0)
    bt: Constant = option("", above=0.0)
    bfs: Constant = option("", above=0.0)

    def energy(self, e: Tensor) -> Tensor:
        e11, e22, e33, e12, e23, e13 = components(e)
        along, across = e11.square(), e22.square() + e33.square() + 2 * e23.square()
        shear = 2 * (e12.square() + e13.square())
        c, bf, bt, bfs = self.constants
        return c / 2 * torch.expm1((bf * along + bt * across + bfs * shear) / 4)

    @staticmethod
    def strain_derivatives(c: Any, e: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        # dQ/dE
        q11, q22, q33 = c[1] * e[0], c[2] * e[1], c[2] * e[2]
        q12, q23, q13 = c[3] * e[3], c[2] * e[4], c[3] * e[5]
        normal = q11 * e[0] + q22 * e[1] + q33 * e[2]
        Q = (normal + 2 * (q12 * e[3] + q23 * e[4] + q13 * e[5])) / 4
        f = c[0] / 2 * exp(Q)
        s11, s22, s33, s12, s23, s13 = f * q11, f * q22, f * q33, f * q12, f * q23, f * q13
        D1 = (s11 * q11 + 2 * f * c[1], s11 * q22, s11 * q33, s11 * q12, s11 * q23, s11 * q13)
        D2 = (s22 * q22 + 2 * f * c[2], s22 * q33, s22 * q12, s22 * q23, s22 * q13)
        D3 = (s33 * q33 + 2 * f * c[2], s33 * q12, s33 * q23, s33 * q13)
        D4 = (s12 * q12 + f * c[3], s12 * q23, s12 * q13)
        D5 = (s23 * q23 + f * c[2], s23 * q13, s13 * q13 + f * c[3])
        return (s11, s22, s33, s12, s23, s13), D1 + D2 + D3 + D4 + D5


@dataclass(frozen=True)
class HolzapfelGasserOgdenFibres(FibreEnergy, Scalable):
    """Families of dispersed fibres: sum of k1/(2 k2) (exp(k2 <E_i>^2) - 1) over the families.

    E_i = kappa (I1 - 3) + (1 - 3 kappa) (I4_i - 1), I4_i = C : (a_i x a_i), <x> = max(x, 0): a
    family has no stress where E_i < 0. The directions a_i lie at +angle and -angle to f in the
    plane of f and s.

    Source: Gasser, Ogden, Holzapfel (2006), J. R. Soc. Interface 3.

    Attributes:
        k1: Modulus over E [-].
        k2: Exponent [-].
        kappa: Dispersion [-]: 0 for parallel fibres, 1/3 for directions without preference.
        angle: Angle between f and the fibres [rad].
        families: 2, or 1 for the fibres at +angle alone.
    """

    ranged: ClassVar[tuple[str, ...]] = ("k1", "k2", "kappa")
    dimensional: ClassVar[tuple[str, ...]] = ("k1",)

    k1: Constant = option("", above=0.0)
    k2: Constant = option("", above=0.0)
    kappa: Constant = option("", default=0.0, least=0.0, most=1 / 3)
    angle: float = option("rad", default=0.0)
    families: int = 2

    def check_constants(self) -> None:
        if self.families not in (1, 2):
            raise ValueError(f"families = {self.families} must be 1 or 2")

    def energy(self, e: Tensor) -> Tensor:
        k1, k2, m11, m22, m33, m12, n12 = self.constants
        e11, e22, e33, e12, _, _ = components(e)
        normal = m11 * e11 + m22 * e22 + m33 * e33
        families = (positive_part(normal + 2 * shear * e12) for shear in (m12, n12))
        return sum((_exponential_energy(k1, k2, x) for x in families), 0 * e11)

    @property
    def constants(self) -> tuple[Tensor, ...]:
        """Return k1, k2 and the tensors M_i = dE_i/de: M11, M22, M33 and M12 of each family.

        A single family is two equal families with half of k1.
        """
        k1, k2, kappa = super().constants
        cos, sin, axial = math.cos(self.angle), math.sin(self.angle), 1 - 3 * kappa
        normal = kappa + axial * cos**2, kappa + axial * sin**2, kappa
        shear = axial * cos * sin
        if self.families == 1:
            return k1 / 2, k2, *normal, shear, shear
        return k1, k2, *normal, shear, -shear

    @staticmethod
    def strain_derivatives(c: Any, e: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        normal = c[2] * e[0] + c[3] * e[1] + c[4] * e[2]
        m1, m2 = tension_derivatives(c[0], c[1], normal + 2 * c[5] * e[3])
        n1, n2 = tension_derivatives(c[0], c[1], normal + 2 * c[6] * e[3])
        both, shear = 2 * (m1 + n1), 2 * (m1 * c[5] + n1 * c[6])
        S = (both * c[2], both * c[3], both * c[4], shear, 0.0, 0.0)
        f, g = 4 * (m2 + n2), 4 * (m2 * c[5] + n2 * c[6])
        D1 = (f * c[2] * c[2], f * c[2] * c[3], f * c[2] * c[4], g * c[2], 0.0, 0.0)
        D2 = (f * c[3] * c[3], f * c[3] * c[4], g * c[3], 0.0, 0.0)
        D3 = (f * c[4] * c[4], g * c[4], 0.0, 0.0)
        D4 = (4 * (m2 * c[5] * c[5] + n2 * c[6] * c[6]), 0.0, 0.0)
        return S, D1 + D2 + D3 + D4 + (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class HolzapfelOgdenFibres(FibreEnergy, Scalable):
    """Fibres and sheets of the myocardium.

    W = af/(2 bf) (exp(bf <I4f - 1>^2) - 1) + as/(2 bs) (exp(bs <I4s - 1>^2) - 1)
    + afs/(2 bfs) (exp(bfs I8fs^2) - 1), <x> = max(x, 0): fibres and sheets have no stress where
    they are shortened. I4f = C11, I4s = C22 and I8fs = C12.

    Source: Holzapfel, Ogden (2009), Phil. Trans. R. Soc. A 367.

    Attributes:
        af, as_, afs: Moduli over E [-] of fibres, sheets and shear between them; `as_` and `afs`
            may be 0.
        bf, bs, bfs: Exponents [-].
    """

    ranged: ClassVar[tuple[str, ...]] = ("af", "bf", "as_", "bs", "afs", "bfs")
    dimensional: ClassVar[tuple[str, ...]] = ("af", "as_", "afs")

    af: Constant = option("", above=0.0)
    bf: Constant = option("", above=0.0)
    as_: Constant = option("", least=0.0)
    bs: Constant = option("", above=0.0)
    afs: Constant = option("", least=0.0)
    bfs: Constant = option("", above=0.0)

    def energy(self, e: Tensor) -> Tensor:
        e11, e22, _, e12, _, _ = components(e)
        af, bf, as_, bs, afs, bfs = self.constants
        fibres = _exponential_energy(af, bf, positive_part(e11))
        sheets = _exponential_energy(as_, bs, positive_part(e22))
        return fibres + sheets + _exponential_energy(afs, bfs, e12)

    @staticmethod
    def strain_derivatives(c: Any, e: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        f1, f2 = tension_derivatives(c[0], c[1], e[0])
        s1, s2 = tension_derivatives(c[2], c[3], e[1])
        g1, g2 = exponential_derivatives(c[4], c[5], e[3], 1.0)
        S = (2 * f1, 2 * s1, 0.0, g1, 0.0, 0.0)
        D1 = (4 * f2, 0.0, 0.0, 0.0, 0.0, 0.0)
        D2 = (4 * s2, 0.0, 0.0, 0.0, 0.0)
        return S, D1 + D2 + (0.0, 0.0, 0.0, 0.0, g2, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LinearFibres(FibreEnergy):
    """Quadratic energy E : D : E / 2, the limit of the others at small strains.

    Attributes:
        moduli: The 21 moduli of `strain_derivatives` over E, (21, E or 1, 1) [-].
    """

    ranged: ClassVar[tuple[str, ...]] = ("moduli",)

    moduli: Tensor

    def energy(self, e: Tensor) -> Tensor:
        S = self.strain_derivatives(self.constants, components(e))[0]
        twice = [1, 1, 1, 2, 2, 2]
        return sum(k / 4 * s * x for k, s, x in zip(twice, S, components(e), strict=True))

    @property
    def constants(self) -> tuple[Tensor, ...]:
        return tuple(self.moduli)

    @staticmethod
    def strain_derivatives(c: Any, e: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        E11, E22, E33, E12, E23, E13 = e[0] / 2, e[1] / 2, e[2] / 2, e[3], e[4], e[5]
        S = (
            c[0] * E11 + c[1] * E22 + c[2] * E33 + c[3] * E12 + c[4] * E23 + c[5] * E13,
            c[1] * E11 + c[6] * E22 + c[7] * E33 + c[8] * E12 + c[9] * E23 + c[10] * E13,
            c[2] * E11 + c[7] * E22 + c[11] * E33 + c[12] * E12 + c[13] * E23 + c[14] * E13,
            c[3] * E11 + c[8] * E22 + c[12] * E33 + c[15] * E12 + c[16] * E23 + c[17] * E13,
            c[4] * E11 + c[9] * E22 + c[13] * E33 + c[16] * E12 + c[18] * E23 + c[19] * E13,
            c[5] * E11 + c[10] * E22 + c[14] * E33 + c[17] * E12 + c[19] * E23 + c[20] * E13,
        )
        return S, c


@linear_law.register
def _of_fibres(law: FibreEnergy, moduli: Tensor) -> LinearFibres:
    return LinearFibres(moduli.view(21, -1, 1))


def as_tensors(entries: tuple[Any, ...], e: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Return numbers and tensors as tensors of one shape; type and device are those of e."""
    full = [torch.as_tensor(entry).to(e[0]) for entry in (e[0], *entries)]
    return torch.broadcast_tensors(*full)[1:]


def components(e: Tensor) -> tuple[Tensor, ...]:
    """Return the components 11, 22, 33, 12, 23, 13, (...,) each, of e (..., 3, 3)."""
    return tuple(e[..., i, j] for i, j in COMPONENTS)


def exponential_derivatives(a: Any, b: Any, y: Any, slope: Any) -> tuple[Any, Any]:
    """Return the first two derivatives of a/(2 b) (exp(b y^2) - 1) by x, where y' is 0 or 1."""
    square = b * y * y
    f = a * exp(square)
    return f * y, f * (slope + 2 * square)


def tension_derivatives(a: Any, b: Any, x: Any) -> tuple[Any, Any]:
    """Return the first two derivatives of a/(2 b) (exp(b <x>^2) - 1), <x> = max(x, 0)."""
    return exponential_derivatives(a, b, positive_part(x), step(x))


def _exponential_energy(a: Tensor, b: Tensor, x: Tensor) -> Tensor:
    """Return a/(2 b) (exp(b x^2) - 1)."""
    return a / (2 * b) * torch.expm1(b * x.square())

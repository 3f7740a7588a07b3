"""Hyperelastic laws: one class = one energy density of the displacement gradient.

Laws take the displacement gradient H = F - I and not F: for |H| near 1e-10 the strain is lost in
the rounding of 1 + H, and with it the equilibrium of small loads. For the same reason no law forms
its stress as a difference of terms that cancel at rest.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor


class Response(NamedTuple):
    """Stress and moduli at a strain.

    Attributes:
        stress: Second Piola-Kirchhoff stress S over Young's modulus, (..., 3, 3) [-].
        moduli: dS/dE, (..., 3, 3, 3, 3) [-], with minor and major symmetry.
    """

    stress: Tensor
    moduli: Tensor

    def product(self, change: Tensor) -> Tensor:
        """Return dS/dE : change, (..., 3, 3) [-], of a symmetric change of strain."""
        return torch.einsum("...ijkl,...kl->...ij", self.moduli, change)

    def tangent(self, H: Tensor) -> Tensor:
        """Return dP/dF, (..., 3, 3, 3, 3) [-], indexed iJkL, of a body deformed by F = I + H."""
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        F = H + eye
        A = torch.einsum("...iM,...MJNL,...kN->...iJkL", F, self.moduli, F)
        return A + torch.einsum("ik,...JL->...iJkL", eye, self.stress)


class Material:
    """Isotropic hyperelastic law, its moduli over Young's modulus E.

    A law is its `energy`; `stress` and `tangent` follow by automatic differentiation. A subclass
    may give its `response` to strains as well: the two then follow from that, and Newton can take
    strains as unknowns. A law of the invariants (`Isotropic`) is compiled too.
    """

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density over E, (...,) [-], of H (..., 3, 3) [-]."""
        raise NotImplementedError(f"{type(self).__name__} has no energy")

    def response(self, E: Tensor) -> Response:
        """Return stress and moduli at Green-Lagrange strains E, (..., 3, 3) [-].

        Raises:
            NotImplementedError: The law is its energy alone, see `has_response`.
        """
        raise NotImplementedError(f"{type(self).__name__} has no stress as a function of strain")

    @property
    def has_response(self) -> bool:
        """Whether the law gives its stress as a function of strain."""
        return type(self).response is not Material.response

    def stress(self, H: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress P = dW/dF over E, (..., 3, 3) [-]."""
        if self.has_response:
            S = self.response(green_lagrange(H)).stress
            return S + H @ S
        gradient = torch.func.vmap(torch.func.grad(self.energy))
        return gradient(H.reshape(-1, 3, 3)).reshape(H.shape)

    def tangent(self, H: Tensor) -> Tensor:
        """Return dP/dF over E, (..., 3, 3, 3, 3) [-], indexed iJkL."""
        if self.has_response:
            return self.response(green_lagrange(H)).tangent(H)
        hessian = torch.func.vmap(torch.func.hessian(self.energy))
        return hessian(H.reshape(-1, 3, 3)).reshape(*H.shape, 3, 3)

    @property
    def mu(self) -> float:
        """Shear modulus at rest over Young's modulus [-]."""
        return float(self._at_rest[0, 1, 0, 1])

    @property
    def lam(self) -> float:
        """First Lame parameter at rest over Young's modulus [-]."""
        return float(self._at_rest[0, 0, 1, 1])

    @property
    def poisson_ratio(self) -> float:
        """Poisson's ratio at rest [-]."""
        return self.lam / (2 * (self.lam + self.mu))

    @property
    def _at_rest(self) -> Tensor:
        return self.tangent(torch.zeros(1, 3, 3, dtype=torch.float64))[0]


@dataclass(frozen=True)
class Hookean(Material):
    """Law that at rest is Hooke's, with Young's modulus 1: such laws can be swapped fairly.

    Attributes:
        poisson: Poisson's ratio at rest [-], in (-1, 0.5).
    """

    poisson: float

    def __post_init__(self) -> None:
        """Check the range.

        Raises:
            ValueError: `poisson` lies outside (-1, 0.5) or is no finite number.
        """
        if not (math.isfinite(self.poisson) and -1.0 < self.poisson < 0.5):
            raise ValueError(
                f"poisson = {self.poisson} must lie between -1 and 0.5 (both excluded)"
            )

    @property
    def mu(self) -> float:
        """Shear modulus over Young's modulus [-]."""
        return 1.0 / (2.0 * (1.0 + self.poisson))

    @property
    def lam(self) -> float:
        """First Lame parameter over Young's modulus [-]."""
        return self.poisson / ((1.0 + self.poisson) * (1.0 - 2.0 * self.poisson))

    @property
    def bulk(self) -> float:
        """Bulk modulus over Young's modulus [-]."""
        return self.lam + 2 / 3 * self.mu


class Isotropic(Material):
    """Law of the invariants, W(I1, I2, J) of C = F^T F, given by its `slopes` as well.

    The slopes are plain arithmetic on numbers of any kind: tensors here, lanes of a processor in
    `dpl.fem.kernels`. With X = C^-1, the stress they stand for is

        S = (rest + 2 W2 i1) I - 4 W2 E - p (I - X),   I - X = 2 E X,

    in which nothing cancels at rest.

    Attributes:
        finite: False for the one law whose strain is the symmetric part of H.
    """

    finite: ClassVar[bool] = True

    @property
    def constants(self) -> tuple[float, ...]:
        """Moduli that the slopes take."""
        raise NotImplementedError

    @staticmethod
    def slopes(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> tuple[Any, ...]:
        """Return (rest, W2, p, W11, W12, W22, J W1J, J W2J, J p_J).

        Indices are derivatives, p = J W_J, and rest = p + 2 W1 + 4 W2, which is zero at rest and
        must be given in a form that is small there.

        Args:
            c: `constants`.
            i1, i2, j: I1 - 3, I2 - 3, J - 1.
            log_j: ln J.
            m1: J^(-2/3) - 1.
        """
        raise NotImplementedError

    def response(self, E: Tensor) -> Response:
        """Return stress and moduli, see `Material.response`."""
        e = 2 * E
        i1, second, square = invariants(e)
        j = square / (1 + (1 + square).sqrt())
        eye = torch.eye(3, dtype=E.dtype, device=E.device)
        X = inverse_transpose(e, square)
        slopes = self._slopes(i1, 2 * i1 + second, j)
        S = _stress(e, square, i1, slopes)
        _, W2, p, *curvatures = (
            s[..., None, None, None, None] if isinstance(s, Tensor) else s for s in slopes
        )
        W11, W12, W22, W1J, W2J, pJ = curvatures
        T1, T2 = 2 * eye.expand_as(e), 2 * ((2 + i1)[..., None, None] * eye - e)
        D = W11 * _dyad(T1, T1) + W22 * _dyad(T2, T2) + pJ * _dyad(X, X)
        for factor, A, B in ((W12, T1, T2), (W1J, T1, X), (W2J, T2, X)):
            D = D + factor * (_dyad(A, B) + _dyad(B, A))
        D = D + 4 * W2 * (_dyad(eye, eye) - _symmetric_product(eye)) - 2 * p * _symmetric_product(X)
        return Response(S, D)

    def stress(self, H: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress, see `Material.stress`.

        J is that of H, with its sign: inverted, a law with ln J has no stress (NaN).
        """
        e = 2 * green_lagrange(H)
        i1, second, square = invariants(e)
        slopes = self._slopes(i1, 2 * i1 + second, volume_change(H))
        S = _stress(e, square, i1, slopes)
        return S + H @ S

    def _slopes(self, i1: Tensor, i2: Tensor, j: Tensor) -> tuple[Tensor | float, ...]:
        log_j = torch.log1p(j)
        m1 = torch.expm1(-2 / 3 * log_j)
        return self.slopes(self.constants, i1, i2, j, log_j, m1)


def _stress(e: Tensor, square: Tensor, i1: Tensor, slopes: tuple[Tensor | float, ...]) -> Tensor:
    """Return S (..., 3, 3) of `Isotropic` at e = 2 E = C - I with det C = 1 + square."""
    rest, W2, p = (s[..., None, None] if isinstance(s, Tensor) else s for s in slopes[:3])
    eye = torch.eye(3, dtype=e.dtype, device=e.device)
    S = (rest + 2 * W2 * i1[..., None, None]) * eye
    if isinstance(W2, Tensor) or W2:
        S = S - 2 * W2 * e
    if isinstance(p, Tensor) or p:  # else a collapsed body, C singular, has a stress too
        S = S - p * (e @ inverse_transpose(e, square))
    return S


def _dyad(A: Tensor, B: Tensor) -> Tensor:
    """Return A_ij B_kl, (..., 3, 3, 3, 3)."""
    return A[..., :, :, None, None] * B[..., None, None, :, :]


def _symmetric_product(A: Tensor) -> Tensor:
    """Return (A_ik A_jl + A_il A_jk)/2, (..., 3, 3, 3, 3)."""
    product = A[..., :, None, :, None] * A[..., None, :, None, :]
    return (product + product.transpose(-1, -2)) / 2


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

    Source: Bonet, Wood (2008), eq. 6.29 at small strains. Exact where rotations are small; one
    Newton step answers any load.
    """

    finite: ClassVar[bool] = False

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        strain = (H + H.mT) / 2
        return self.lam / 2 * trace(H).square() + self.mu * strain.square().sum((-2, -1))

    def stress(self, H: Tensor) -> Tensor:
        """Return lambda tr eps I + 2 mu eps, see `Material.stress`."""
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        return self.lam * trace(H)[..., None, None] * eye + self.mu * (H + H.mT)

    def tangent(self, H: Tensor) -> Tensor:
        """Return Hooke's moduli, see `Material.tangent`."""
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        hooke = self.lam * _dyad(eye, eye) + 2 * self.mu * _symmetric_product(eye)
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

    With m = 4 mu/3, l = lambda + 5 mu/6 and a = 1 + 3 m/(4 l). Finite for any F, inverted or not:
    a body may rest inverted. The energy at rest is not zero.

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
        _check_moduli("2 (c10 + c01)", 2 * (self.c10 + self.c01), self.bulk)

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
        _check_moduli("2 c10", 2 * self.c10, self.bulk)

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


def _check_moduli(name: str, shear: float, bulk: float) -> None:
    """Raise ValueError if a shear modulus, called `name`, or a bulk modulus is not above 0."""
    if not 0 < shear < math.inf:
        raise ValueError(f"{name} = {shear} must be above 0: it is the shear modulus at rest")
    if not 0 < bulk < math.inf:
        raise ValueError(f"bulk = {bulk} must be above 0")


@dataclass(frozen=True)
class OgdenK2(Material):
    """Ogden's solid: sum 2 mu_i/alpha_i^2 (lb1^alpha_i + lb2^alpha_i + lb3^alpha_i - 3)
    + bulk/2 (J - 1)^2, lb = J^(-1/3) lambda the isochoric principal stretches.

    The shear modulus at rest is sum mu_i, as Abaqus defines them; in Ogden's own paper it is
    sum mu_i alpha_i / 2.

    Source: Ogden (1972), Proc. R. Soc. A 326; moduli by Simo, Taylor (1991), CMAME 85, section 2.

    Attributes:
        shear: mu_i over E [-].
        exponents: alpha_i [-], as many.
        bulk: Over E [-].
    """

    shear: Sequence[float]
    exponents: Sequence[float]
    bulk: float

    def __post_init__(self) -> None:
        """Check the range.

        Raises:
            ValueError: Not as many exponents as moduli, an exponent of 0, or a body that would not
                resist shear or compression.
        """
        if len(self.shear) != len(self.exponents) or not all(self.exponents):
            raise ValueError(
                f"exponents = {list(self.exponents)} must be {len(self.shear)} numbers other than 0"
            )
        _check_moduli("sum of shear", sum(self.shear), self.bulk)

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        j = volume_change(H)
        logs = torch.log1p(2 * torch.linalg.eigvalsh(green_lagrange(H))) / 2
        logs = logs - torch.log1p(j)[..., None] / 3
        terms = [
            2 * mu / a**2 * torch.expm1(a * logs).sum(-1)
            for mu, a in zip(self.shear, self.exponents, strict=True)
        ]
        return sum(terms) + self.bulk / 2 * j.square()

    def stress(self, H: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress, see `Material.stress`; NaN where inverted."""
        S = _SpectralStress.apply(green_lagrange(H), self)
        S = torch.where((volume_change(H) > -1)[..., None, None], S, torch.nan)
        return S + H @ S

    def response(self, E: Tensor) -> Response:
        """Return stress and moduli, see `Material.response`."""
        strain, axes = torch.linalg.eigh(E)
        stress, slopes = self._principal(strain)
        gap = strain[..., :, None] - strain[..., None, :]
        same = gap.abs() < 1e-6  # there the quotient is its limit, to within as much
        limit = slopes.diagonal(dim1=-2, dim2=-1)
        limit = (limit[..., :, None] + limit[..., None, :]) / 2 - slopes
        quotient = (stress[..., :, None] - stress[..., None, :]) / torch.where(same, 1.0, gap)
        shear = torch.where(same, limit, quotient)
        shear = shear - torch.diag_embed(shear.diagonal(dim1=-2, dim2=-1))
        S = (axes * stress[..., None, :]) @ axes.mT
        normal = axes[..., :, None, :] * axes[..., None, :, :]  # (..., i, j, a)
        D = torch.einsum("...ija,...ab,...klb->...ijkl", normal, slopes, normal)
        pair = torch.einsum("...ia,...jb->...ijab", axes, axes)
        pair = (pair + pair.transpose(-4, -3)) / 2
        return Response(S, D + torch.einsum("...ijab,...ab,...klab->...ijkl", pair, shear, pair))

    def _principal(self, strain: Tensor) -> tuple[Tensor, Tensor]:
        """Return principal stresses S_a (..., 3) and dS_a/dE_b (..., 3, 3) at principal strains."""
        logs = torch.log1p(2 * strain) / 2
        log_J = logs.sum(-1, keepdim=True)
        j = torch.expm1(log_J)
        eye = torch.eye(3, dtype=strain.dtype, device=strain.device)
        T = self.bulk * (1 + j) * j + torch.zeros_like(logs)
        dT = (self.bulk * (1 + j) * (1 + 2 * j))[..., None] + torch.zeros_like(eye)
        for mu, a in zip(self.shear, self.exponents, strict=True):
            grown = torch.expm1(a * (logs - log_J / 3))  # lb^a - 1
            mean = grown.mean(-1, keepdim=True)
            T = T + 2 * mu / a * (grown - mean)
            power, third = 1 + grown, (1 + mean) / 3
            dT = dT + 2 * mu * (
                power[..., :, None] * eye
                - (power[..., :, None] + power[..., None, :]) / 3
                + third[..., None]
            )
        stretch = 1 + 2 * strain
        slopes = (dT - 2 * T[..., :, None] * eye) / (stretch[..., :, None] * stretch[..., None, :])
        return T / stretch, slopes


class _SpectralStress(torch.autograd.Function):
    """S(E) of a law, differentiated by its moduli: those of eigenvectors are infinite at rest."""

    generate_vmap_rule = True

    @staticmethod
    def forward(E: Tensor, law: OgdenK2) -> Tensor:
        return law.response(E).stress

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, OgdenK2], output: Tensor) -> None:
        E, law = inputs
        ctx.law = law
        ctx.save_for_backward(E)
        ctx.save_for_forward(E)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (E,) = ctx.saved_tensors
        return ctx.law.response(E).product((gradient + gradient.mT) / 2), None

    @staticmethod
    def jvp(ctx: Any, change: Tensor, _: None) -> Tensor:
        (E,) = ctx.saved_tensors
        return ctx.law.response(E).product(change)


def trace(H: Tensor) -> Tensor:
    """Return tr H, (...,), of H (..., 3, 3)."""
    return H.diagonal(dim1=-2, dim2=-1).sum(-1)


def green_lagrange(H: Tensor) -> Tensor:
    """Return the Green-Lagrange strain (H + H^T + H^T H)/2, (..., 3, 3) [-]."""
    return (H + H.mT + H.mT @ H) / 2


def invariants(e: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return tr e, its sum of principal minors and det(I + e) - 1, (...,), of e (..., 3, 3)."""
    (a, b, c), (d, f, g), (h, i, k) = (row.unbind(-1) for row in e.unbind(-2))
    first, second = a + f + k, a * f - b * d + f * k - g * i + a * k - c * h
    third = a * (f * k - g * i) - b * (d * k - g * h) + c * (d * i - f * h)
    return first, second, first + second + third


def volume_change(H: Tensor) -> Tensor:
    """Return det F - 1, (...,) [-], of H = F - I (..., 3, 3), to full relative precision.

    From the invariants of H and not by `torch.linalg.det`: its second derivative at F = I is NaN.
    """
    return invariants(H)[2]


def cofactor(F: Tensor) -> Tensor:
    """Return cof F, (..., 3, 3)."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in F.unbind(-2))
    entries = [
        *(e * i - f * h, f * g - d * i, d * h - e * g),
        *(c * h - b * i, a * i - c * g, b * g - a * h),
        *(b * f - c * e, c * d - a * f, a * e - b * d),
    ]
    # components first in memory, as `Problem` lays H out: elementwise work then runs along rows
    return torch.stack(entries).unflatten(0, (3, 3)).movedim((0, 1), (-2, -1))


def inverse_transpose(H: Tensor, change: Tensor) -> Tensor:
    """Return F^-T, (..., 3, 3) [-], of F = I + H with det F = 1 + change."""
    F = H + torch.eye(3, dtype=H.dtype, device=H.device)
    return cofactor(F) / (1 + change)[..., None, None]

"""Hyperelastic laws: one class = one energy density of the displacement gradient.

Laws take the displacement gradient H = F - I and not F: for |H| near 1e-10 the strain is lost in
the rounding of 1 + H, and with it the equilibrium of small loads.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor


class Response(NamedTuple):
    """Stress and moduli at a strain: dS/dE = a X x X + b (X_ik X_jl + X_il X_jk).

    Attributes:
        stress: Second Piola-Kirchhoff stress S over Young's modulus, (..., 3, 3) [-].
        bulk: a, (..., 1, 1) [-].
        shear: b, (..., 1, 1) [-].
        metric: X, symmetric, (..., 3, 3) [-].
    """

    stress: Tensor
    bulk: Tensor
    shear: Tensor
    metric: Tensor

    def product(self, change: Tensor) -> Tensor:
        """Return dS/dE : change, (..., 3, 3) [-], of a symmetric change of strain."""
        X = self.metric
        bulk = self.bulk * (X * change).sum((-2, -1), keepdim=True)
        return bulk * X + 2 * self.shear * (X @ change @ X)

    def tangent(self, H: Tensor) -> Tensor:
        """Return dP/dF, (..., 3, 3, 3, 3) [-], indexed iJkL, of a body deformed by F = I + H."""
        X, eye = self.metric, torch.eye(3, dtype=H.dtype, device=H.device)
        Y = X + H @ X
        A = torch.einsum("...ij,...kl->...ijkl", self.bulk * Y, Y)
        A += torch.einsum("...il,...kj->...ijkl", self.shear * Y, Y)
        A += torch.einsum("...ik,...jl->...ijkl", self.shear * (Y + Y @ H.mT), X)
        return A + torch.einsum("ik,...jl->...ijkl", eye, self.stress)


@dataclass(frozen=True)
class Material:
    """Isotropic hyperelastic law with Young's modulus 1.

    A law is its `energy`; `stress` and `tangent` follow by automatic differentiation. A subclass
    may give its `response` to strains as well: the two then follow from that, and Newton can take
    strains as unknowns.

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


@dataclass(frozen=True)
class SaintVenantKirchhoff(Material):
    """Saint Venant-Kirchhoff solid: lambda/2 (tr E)^2 + mu E:E, E = (F^T F - I)/2.

    Source: Bonet, Wood (2008), eq. 6.28. It softens in compression: no answer need exist there.
    """

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        E = green_lagrange(H)
        return self.lam / 2 * trace(E).square() + self.mu * E.square().sum((-2, -1))

    def response(self, E: Tensor) -> Response:
        """Return S = lambda tr E I + 2 mu E with Hooke's moduli, see `Material.response`."""
        eye = torch.eye(3, dtype=E.dtype, device=E.device).expand_as(E)
        one = torch.ones_like(E[..., :1, :1])
        S = self.lam * trace(E)[..., None, None] * eye + 2 * self.mu * E
        return Response(S, self.lam * one, self.mu * one, eye)


@dataclass(frozen=True)
class NeoHookean(Material):
    """Compressible neo-Hookean solid NH-ln: mu/2 (I1 - 3 - 2 ln J) + lambda/2 (ln J)^2.

    Source: Bonet, Wood (2008), eq. 6.27. Infinite at J = 0; undefined (NaN) below.
    """

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        log_J = torch.log1p(volume_change(H))
        I1_minus_3 = 2 * trace(H) + H.square().sum((-2, -1))
        return self.mu / 2 * (I1_minus_3 - 2 * log_J) + self.lam / 2 * log_J.square()

    def stress(self, H: Tensor) -> Tensor:
        """Return P = mu (F - F^-T) + lambda ln J F^-T, see `Material.stress`.

        With F^-T = I - X / J and X = H^T + (J - 1 - tr H) I - cof H, so that nothing cancels for
        small H.
        """
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        cof, rest = cofactor(H)
        change = trace(H) + rest
        pressure = self.lam * torch.log1p(change)
        X = H.mT - cof + rest[..., None, None] * eye
        shear = (self.mu - pressure) / (1 + change)
        return self.mu * H + shear[..., None, None] * X + pressure[..., None, None] * eye

    def response(self, E: Tensor) -> Response:
        """Return S = (2 mu E + lambda ln J I) C^-1, C = I + 2 E, see `Material.response`."""
        change = volume_change(2 * E)  # det C - 1
        inverse = inverse_transpose(2 * E, change)
        pressure = self.lam / 2 * torch.log1p(change)[..., None, None]
        one = torch.ones_like(pressure)
        S = 2 * self.mu * E @ inverse + pressure * inverse
        return Response(S, self.lam * one, self.mu - pressure, inverse)


def trace(H: Tensor) -> Tensor:
    """Return tr H, (...,), of H (..., 3, 3)."""
    return H.diagonal(dim1=-2, dim2=-1).sum(-1)


def green_lagrange(H: Tensor) -> Tensor:
    """Return the Green-Lagrange strain (H + H^T + H^T H)/2, (..., 3, 3) [-]."""
    return (H + H.mT + H.mT @ H) / 2


def volume_change(H: Tensor) -> Tensor:
    """Return det F - 1, (...,) [-], of H = F - I (..., 3, 3), to full relative precision.

    From the invariants of H and not by `torch.linalg.det`: its second derivative at F = I is NaN.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in H.unbind(-2))
    third = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    return a + e + i + (a * e - b * d + e * i - f * h + a * i - c * g) + third


def cofactor(H: Tensor) -> tuple[Tensor, Tensor]:
    """Return cof H, (..., 3, 3), and det(I + H) - 1 - tr H, (...,) [-]."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in H.unbind(-2))
    entries = [
        *(e * i - f * h, f * g - d * i, d * h - e * g),
        *(c * h - b * i, a * i - c * g, b * g - a * h),
        *(b * f - c * e, c * d - a * f, a * e - b * d),
    ]
    # components first in memory, as `Problem` lays H out: elementwise work then runs along rows
    cof = torch.stack(entries).unflatten(0, (3, 3)).movedim((0, 1), (-2, -1))
    determinant = a * entries[0] + b * entries[1] + c * entries[2]
    return cof, entries[0] + entries[4] + entries[8] + determinant


def inverse_transpose(H: Tensor, change: Tensor) -> Tensor:
    """Return F^-T, (..., 3, 3) [-], of F = I + H with det F = 1 + change."""
    F = H + torch.eye(3, dtype=H.dtype, device=H.device)
    return cofactor(F)[0] / (1 + change)[..., None, None]

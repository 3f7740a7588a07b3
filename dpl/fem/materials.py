"""Hyperelastic laws: one class = one energy density of the displacement gradient.

Laws take the displacement gradient H = F - I and not F: for |H| near 1e-10 the strain is lost in
the rounding of 1 + H, and with it the equilibrium of small loads.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Material:
    """Isotropic hyperelastic law with Young's modulus 1.

    A law is its `energy`; `stress` and `tangent` follow by automatic differentiation. A subclass
    may give them in closed form as well, for speed.

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

    def stress(self, H: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress P = dW/dF over E, (..., 3, 3) [-]."""
        gradient = torch.func.vmap(torch.func.grad(self.energy))
        return gradient(H.reshape(-1, 3, 3)).reshape(H.shape)

    def tangent(self, H: Tensor) -> Tensor:
        """Return dP/dF over E, (..., 3, 3, 3, 3) [-], indexed iJkL."""
        hessian = torch.func.vmap(torch.func.hessian(self.energy))
        return hessian(H.reshape(-1, 3, 3)).reshape(*H.shape, 3, 3)

    def second_stress(self, E: Tensor) -> Tensor:
        """Return the second Piola-Kirchhoff stress S, (..., 3, 3) [-], of strains (..., 3, 3)."""
        raise NotImplementedError(f"{type(self).__name__} has no stress as a function of strain")

    def second_tangent(self, E: Tensor) -> Tensor:
        """Return dS/dE, (..., 3, 3, 3, 3) [-], of Green-Lagrange strains."""
        raise NotImplementedError(f"{type(self).__name__} has no stress as a function of strain")

    @property
    def has_second_stress(self) -> bool:
        """Whether the law gives its stress as a function of strain, which mixed points need."""
        return type(self).second_stress is not Material.second_stress


@dataclass(frozen=True)
class SaintVenantKirchhoff(Material):
    """Saint Venant-Kirchhoff solid: lambda/2 (tr E)^2 + mu E:E, E = (F^T F - I)/2.

    Source: Bonet, Wood (2008), eq. 6.28. It softens in compression: no answer need exist there.
    """

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        E = green_lagrange(H)
        return self.lam / 2 * trace(E).square() + self.mu * E.square().sum((-2, -1))

    def stress(self, H: Tensor) -> Tensor:
        """Return P = F S, see `Material.stress`."""
        S = self.second_stress(green_lagrange(H))
        return S + H @ S

    def tangent(self, H: Tensor) -> Tensor:
        """Return dP/dF, see `Material.tangent`."""
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        F, S = eye + H, self.second_stress(green_lagrange(H))
        A = self.lam * torch.einsum("...ij,...kl->...ijkl", F, F)
        A += self.mu * torch.einsum("...il,...kj->...ijkl", F, F)
        A += self.mu * torch.einsum("...ik,jl->...ijkl", F @ F.mT, eye)
        return A + torch.einsum("ik,...jl->...ijkl", eye, S)

    def second_stress(self, E: Tensor) -> Tensor:
        """Return S = lambda tr E I + 2 mu E, see `Material.second_stress`."""
        eye = torch.eye(3, dtype=E.dtype, device=E.device)
        return self.lam * trace(E)[..., None, None] * eye + 2 * self.mu * E

    def second_tangent(self, E: Tensor) -> Tensor:
        """Return Hooke's constant moduli, see `Material.second_tangent`."""
        eye = torch.eye(3, dtype=E.dtype, device=E.device)
        D = self.lam * torch.einsum("ij,kl->ijkl", eye, eye)
        D += self.mu * torch.einsum("ik,jl->ijkl", eye, eye)
        D += self.mu * torch.einsum("il,jk->ijkl", eye, eye)
        return D.expand(*E.shape, 3, 3)


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

    def tangent(self, H: Tensor) -> Tensor:
        """Return dP/dF, see `Material.tangent`."""
        change = volume_change(H)
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        G = inverse_transpose(H, change)
        shear = (self.mu - self.lam * torch.log1p(change))[..., None, None]
        A = torch.einsum("...il,...kj->...ijkl", shear * G, G)
        A += self.lam * torch.einsum("...ij,...kl->...ijkl", G, G)
        return A + self.mu * torch.einsum("ik,jl->ijkl", eye, eye)

    def second_stress(self, E: Tensor) -> Tensor:
        """Return S = (2 mu E + lambda ln J I) C^-1, C = I + 2 E, see `Material.second_stress`."""
        inverse, log_J = self._inverse_and_log(E)
        eye = torch.eye(3, dtype=E.dtype, device=E.device)
        return (2 * self.mu * E + self.lam * log_J * eye) @ inverse

    def second_tangent(self, E: Tensor) -> Tensor:
        """Return dS/dE, see `Material.second_tangent`."""
        inverse, log_J = self._inverse_and_log(E)
        shear = (self.mu - self.lam * log_J) * inverse
        D = self.lam * torch.einsum("...ij,...kl->...ijkl", inverse, inverse)
        D += torch.einsum("...ik,...jl->...ijkl", shear, inverse)
        return D + torch.einsum("...il,...jk->...ijkl", shear, inverse)

    def _inverse_and_log(self, E: Tensor) -> tuple[Tensor, Tensor]:
        """Return C^-1 and ln J (..., 1, 1)."""
        change = volume_change(2 * E)  # of C, J^2 - 1
        return inverse_transpose(2 * E, change), torch.log1p(change)[..., None, None] / 2


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

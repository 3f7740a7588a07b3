"""Ogden's law, in principal stretches."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from dpl.fem.materials.material import BulkOrPoisson, Response
from dpl.fem.materials.tensors import green_lagrange, volume_change
from dpl.fem.options import option


@dataclass(frozen=True)
class OgdenK2(BulkOrPoisson):
    """Ogden's solid: sum 2 mu_i/alpha_i^2 (lb1^alpha_i + lb2^alpha_i + lb3^alpha_i - 3)
    + bulk/2 (J - 1)^2, lb = J^(-1/3) lambda the isochoric principal stretches.

    The shear modulus at rest is sum mu_i, as Abaqus defines them; in Ogden's own paper it is
    sum mu_i alpha_i / 2.

    Source: Ogden (1972), Proc. R. Soc. A 326; moduli by Simo, Taylor (1991), CMAME 85, section 2.

    Attributes:
        shear: mu_i, in the unit of `bulk`.
        exponents: alpha_i [-], as many.
        bulk: Bulk modulus.
        poisson: Poisson's ratio at rest [-], in place of `bulk`.
    """

    dimensional: ClassVar[tuple[str, ...]] = ("shear", "bulk")

    shear: Sequence[float]
    exponents: Sequence[float]
    bulk: float | None = option("", default=None, above=0.0)
    poisson: float | None = option("", default=None, above=-1.0, below=0.5, optional=True)

    def check_constants(self) -> None:
        found, count = list(self.exponents), len(self.shear)
        if len(found) != count or not all(a * a and math.isfinite(a) for a in found):
            raise ValueError(f"exponents = {found} must be {count} numbers other than 0")
        super().check_constants()

    @property
    def constants(self) -> tuple[Any, ...]:
        return *self.shear, *self.exponents

    @property
    def mu(self) -> Tensor:
        return torch.tensor(sum(self.shear) * self.unit, dtype=torch.float64)

    @property
    def _terms(self) -> list[tuple[float, float]]:
        """mu_i over Young's modulus and alpha_i [-]."""
        return [(mu * self.unit, a) for mu, a in zip(self.shear, self.exponents, strict=True)]

    def energy(self, H: Tensor) -> Tensor:
        j = volume_change(H)
        logs = torch.log1p(2 * _spectrum(green_lagrange(H))[0]) / 2
        logs = logs - torch.log1p(j)[..., None] / 3
        terms = [2 * mu / a**2 * torch.expm1(a * logs).sum(-1) for mu, a in self._terms]
        return sum(terms) + self.bulk_modulus / 2 * j.square()

    def stress(self, H: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress, see `Material.stress`; NaN where inverted."""
        S = _SpectralStress.apply(green_lagrange(H), self)
        S = torch.where((volume_change(H) > -1)[..., None, None], S, torch.nan)
        return S + H @ S

    def response(self, E: Tensor) -> Response:
        strain, axes = _spectrum(E)
        stress, moduli = self._principal(strain)
        gap = strain[..., :, None] - strain[..., None, :]
        same = gap.abs() < 1e-6  # there the quotient is its limit, to within as much
        limit = moduli.diagonal(dim1=-2, dim2=-1)
        limit = (limit[..., :, None] + limit[..., None, :]) / 2 - moduli
        quotient = (stress[..., :, None] - stress[..., None, :]) / torch.where(same, 1.0, gap)
        shear = torch.where(same, limit, quotient)
        shear = shear - torch.diag_embed(shear.diagonal(dim1=-2, dim2=-1))
        S = (axes * stress[..., None, :]) @ axes.mT
        normal = axes[..., :, None, :] * axes[..., None, :, :]  # (..., i, j, a)
        D = torch.einsum("...ija,...ab,...klb->...ijkl", normal, moduli, normal)
        pair = torch.einsum("...ia,...jb->...ijab", axes, axes)
        pair = (pair + pair.transpose(-4, -3)) / 2
        return Response(S, D + torch.einsum("...ijab,...ab,...klab->...ijkl", pair, shear, pair))

    def _principal(self, strain: Tensor) -> tuple[Tensor, Tensor]:
        """Return principal stresses S_a (..., 3) and dS_a/dE_b (..., 3, 3) at principal strains."""
        logs = torch.log1p(2 * strain) / 2
        log_J = logs.sum(-1, keepdim=True)
        j = torch.expm1(log_J)
        eye = torch.eye(3, dtype=strain.dtype, device=strain.device)
        bulk = self.bulk_modulus
        T = bulk * (1 + j) * j + torch.zeros_like(logs)
        dT = (bulk * (1 + j) * (1 + 2 * j))[..., None] + torch.zeros_like(eye)
        for mu, a in self._terms:
            grown = torch.expm1(a * (logs - log_J / 3))  # lb^a - 1
            mean = grown.mean(-1, keepdim=True)
            T = T + 2 * mu / a * (grown - mean)
            power, third = 1 + grown, (1 + mean) / 3
            off = (power[..., :, None] + power[..., None, :]) / 3 - third[..., None]
            dT = dT + 2 * mu * (power[..., :, None] * eye - off)
        stretch = 1 + 2 * strain
        moduli = (dT - 2 * T[..., :, None] * eye) / (stretch[..., :, None] * stretch[..., None, :])
        return T / stretch, moduli


def _spectrum(E: Tensor) -> tuple[Tensor, Tensor]:
    """Return eigenvalues (..., 3), NaN where E is not finite (LAPACK stops there), and axes."""
    finite = E.isfinite().all(-1).all(-1)
    values, axes = torch.linalg.eigh(torch.where(finite[..., None, None], E, 0.0))
    return torch.where(finite[..., None], values, torch.nan), axes


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

"""Hooke's law of small strains, of the Green-Lagrange strain, and as the base of unknown laws."""

from dataclasses import dataclass
from functools import singledispatch
from typing import Any, ClassVar

import torch
from torch import Tensor

from dpl.fem.materials.invariant_based import Derivatives, InvariantBasedMaterial
from dpl.fem.materials.material import YoungPoissonMaterial
from dpl.fem.materials.tensors import dyad, green_lagrange, symmetric_product, trace, with_axes


class Hookean(InvariantBasedMaterial):
    """Law with the constants lambda and mu, whose derivatives are those of Hooke's energy."""

    @property
    def constants(self) -> tuple[Tensor, ...]:
        return self.lam, self.mu

    @staticmethod
    def invariant_derivatives(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> Derivatives:
        rest = (c[0] / 2 + c[1]) * i1
        return rest, -c[1] / 2, 0.0, c[0] / 4 + c[1] / 2, 0.0, 0.0, 0.0, 0.0, 0.0


@dataclass(frozen=True)
class SaintVenantKirchhoff(YoungPoissonMaterial, Hookean):
    """Saint Venant-Kirchhoff solid SVK: lambda/2 (tr E)^2 + mu E:E, E = (F^T F - I)/2.

    Source: Bonet, Wood (2008), eq. 6.28. It softens in compression: no answer need exist there.
    """

    def energy(self, H: Tensor) -> Tensor:
        E = green_lagrange(H)
        return self.lam / 2 * trace(E).square() + self.mu * E.square().sum((-2, -1))


class SmallStrains(Hookean):
    """Linear elasticity: lambda/2 (tr eps)^2 + mu eps:eps, eps = (H + H^T)/2.

    Source: Bonet, Wood (2008), eq. 6.29 at small strains.
    """

    finite: ClassVar[bool] = False

    def energy(self, H: Tensor) -> Tensor:
        strain = (H + H.mT) / 2
        return self.lam / 2 * trace(H).square() + self.mu * strain.square().sum((-2, -1))

    def stress(self, H: Tensor) -> Tensor:
        return self.rest_stress(H)

    def tangent(self, H: Tensor) -> Tensor:
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        hooke = with_axes(self.lam, 4) * dyad(eye, eye)
        hooke = hooke + 2 * with_axes(self.mu, 4) * symmetric_product(eye)
        return hooke.expand(*H.shape, 3, 3)


@dataclass(frozen=True)
class LinearElastic(YoungPoissonMaterial, SmallStrains):
    """Linear elasticity of small strains.

    Exact where rotations are small. The tangent does not depend on the displacement: one Newton
    iteration solves any load under which det F stays above `Newton.min_detF_ratio` everywhere.
    Below that the step is shortened. There is no solution where the linear one has det F <= 0.
    """


@dataclass(frozen=True)
class UnknownLaw(YoungPoissonMaterial, SmallStrains):
    """Law of a body of which solutions are known alone: Hooke's law at rest, NaN under strain.

    K(0), linear solutions and networks are those of the elastic constants. Stresses, residuals and
    estimated errors of a deformed body are NaN, and what needs them is refused.
    """

    @property
    def is_known(self) -> bool:
        return False

    @property
    def compiled_form(self) -> None:  # type: ignore[override]
        """None: compiled loops evaluate derivatives, which are Hooke's."""
        return None

    def energy(self, H: Tensor) -> Tensor:
        return torch.where((H == 0).all(dim=(-2, -1)), super().energy(H), torch.nan)

    def stress(self, H: Tensor) -> Tensor:
        is_rest = (H == 0).all(dim=(-2, -1))[..., None, None]
        return torch.where(is_rest, super().stress(H), torch.nan)


@dataclass(frozen=True)
class LameElastic(SmallStrains):
    """Linear elasticity with any Lame parameters, a term of a stiffness; see `StiffnessTerms`.

    Attributes:
        shear, first: mu and lambda over Young's modulus [-]; numbers or fields.
    """

    ranged: ClassVar[tuple[str, ...]] = ("shear", "first")

    shear: float | Tensor
    first: float | Tensor

    @property
    def mu(self) -> Tensor:
        return self.value("shear")

    @property
    def lam(self) -> Tensor:
        return self.value("first")


@singledispatch
def linear_law(law: Any, moduli: Tensor) -> Any:
    """Return the law of small strains with moduli in the order of `rest_moduli`, (M,).

    A kind of parts with other moduli than mu and lambda registers a function.
    """
    if not law.parts:
        return LameElastic(*moduli.view(2, -1, 1))
    counts = [part.rest_moduli.shape[1] for part in law.parts.values()]
    parts = zip(law.parts.items(), moduli.split(counts), strict=True)
    return law.with_parts({name: linear_law(part, own) for (name, part), own in parts})

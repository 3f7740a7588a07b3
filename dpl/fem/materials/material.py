"""What a hyperelastic law is: an energy density of the displacement gradient, and what follows.

Laws take the displacement gradient H = F - I and not F: for |H| near 1e-10 the strain is lost in
the rounding of 1 + H, and with it the equilibrium of small loads. For the same reason no law forms
its stress as a difference of terms that cancel at rest.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import product
from typing import Any, ClassVar, NamedTuple, Self, cast

import torch
from torch import Tensor

from dpl.fem.identity import identity_of
from dpl.fem.materials.parameters import CellField, Constant, Parametrised, Scalable
from dpl.fem.materials.tensors import green_lagrange, trace, with_axes
from dpl.fem.options import option

NEARLY_INCOMPRESSIBLE = 0.45  # largest Poisson's ratio at rest of other laws [-]


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


class CompiledForm(NamedTuple):
    """A law as compiled loops take it: functions of its `constants` in plain arithmetic.

    Attributes:
        isotropic: Law with `invariant_derivatives`, see `InvariantBasedMaterial`.
        fibres: Part with `strain_derivatives`, see `FibreEnergy`, whose constants follow; or None.
        frames: Frames of the fibres, (E or 1, Q or 1, 3, 3) [-]; None without fibres.
    """

    isotropic: Any
    fibres: Any = None
    frames: Tensor | None = None


class Material(Parametrised):
    """Hyperelastic law, its moduli over Young's modulus E.

    A law is its `energy`; `stress` and `tangent` follow by automatic differentiation. A subclass
    may give its `response` to strains as well: the two then follow from that, and Newton can take
    strains as unknowns. A law of the invariants (`InvariantBasedMaterial`) is compiled too.

    Strains of a law with fields or of a batch are (B, E, Q, 3, 3), see `Parametrised`.

    Attributes:
        finite: False for laws whose strain is the symmetric part of H.
    """

    finite: ClassVar[bool] = True

    @property
    def is_known(self) -> bool:
        """False for a body with `UnknownLaw`, which has no stress under strain."""
        return True

    def require_known(self, what: str) -> None:
        """Raise a ValueError if `what`, the key or the method that needs it, has no law."""
        if not self.is_known:
            raise ValueError(f"{what} needs the law of the body; replace {self.describe()} by it")

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density over E, (...,) [-], of H (..., 3, 3) [-]."""
        raise NotImplementedError(f"{type(self).__name__} has no energy")

    def response(self, E: Tensor) -> Response:
        """Return stress and moduli at Green-Lagrange strains E, (..., 3, 3) [-], if it has them."""
        raise NotImplementedError(f"{type(self).__name__} has no stress as a function of strain")

    @property
    def has_response(self) -> bool:
        """True for a law whose stress is a function of the Green-Lagrange strain."""
        return self.finite and type(self).response is not Material.response

    def stress(self, H: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress P = dW/dF over E, (..., 3, 3) [-]."""
        if self.has_response:
            S = self.response(green_lagrange(H)).stress
            return S + H @ S
        return torch.func.grad(lambda G: self.energy(G).sum())(H)

    def tangent(self, H: Tensor) -> Tensor:
        """Return dP/dF over E, (..., 3, 3, 3, 3) [-], indexed iJkL."""
        if self.has_response:
            return self.response(green_lagrange(H)).tangent(H)

        def slope(direction: Tensor) -> Tensor:
            return torch.func.jvp(self.stress, (H,), (direction.expand_as(H),))[1]

        directions = torch.eye(9, dtype=H.dtype, device=H.device).unflatten(-1, (3, 3))
        return torch.func.vmap(slope, out_dims=-1)(directions).unflatten(-1, (3, 3))

    def volumetric_energy(self, j: Tensor) -> Tensor:
        """Return U(J), the energy density over E of F = J^(1/3) I, (...,) [-], at J - 1 = j.

        Of a law with fibres it is that of the matrix, of a law of small strains that of tr H = j.
        """
        return self.energy(self._dilatation(j)[1])

    def pressure(self, j: Tensor) -> Tensor:
        """Return dU/dJ, see `volumetric_energy`, (...,) [-]."""
        stretch, H = self._dilatation(j)
        return self.stress(H)[..., 0, 0] / stretch.square()

    @property
    def point_bulk(self) -> Tensor:
        """Bulk modulus over E that mean dilatation leaves to the quadrature points [-].

        Zero if the energy without that of `volumetric_energy` does not depend on the volume.
        """
        return torch.zeros((), dtype=torch.float64)

    def _dilatation(self, j: Tensor) -> tuple[Tensor, Tensor]:
        """Return stretch (...,) and H (..., 3, 3) [-] of a change of volume alone."""
        growth = torch.expm1(torch.log1p(j) / 3) if self.finite else j / 3
        H = growth[..., None, None] * torch.eye(3, dtype=j.dtype, device=j.device)
        return (1 + growth if self.finite else torch.ones_like(j)), H

    @property
    def compiled_form(self) -> CompiledForm | None:
        """The law as compiled loops take it; None if it has tensor operations only."""
        return None

    def identity(self) -> dict[str, Any]:
        """Return class name and parameters as plain data."""
        return identity_of(self)

    def describe(self) -> str:
        """Return the law in words: its class, numbers and ranges."""
        if not is_dataclass(self):
            return type(self).__name__
        words = []
        for name in (each.name for each in fields(self)):
            value = getattr(self, name)
            if isinstance(value, Tensor):
                words.append(f"{name} from {value.min():.4g} to {value.max():.4g}")
            elif value is not None and (name, value) != ("young", 1) and name != "unit":
                words.append(f"{name}={value!r}")
        return f"{type(self).__name__}({', '.join(words)})"

    @property
    def mu(self) -> Tensor:
        """Shear modulus at rest over Young's modulus [-], of the shape of `Parametrised.value`."""
        return self._tangent_at_rest[..., 0, 1, 0, 1]

    @property
    def lam(self) -> Tensor:
        """First Lame parameter at rest over Young's modulus [-]."""
        return self._tangent_at_rest[..., 0, 0, 1, 1]

    @property
    def bulk_modulus(self) -> Tensor:
        """Bulk modulus at rest over Young's modulus [-]."""
        return self.lam + 2 / 3 * self.mu

    @property
    def poisson_ratio(self) -> Tensor:
        """Poisson's ratio at rest [-]."""
        return self.lam / (2 * (self.lam + self.mu))

    @property
    def _tangent_at_rest(self) -> Tensor:
        rest = torch.zeros(3, 3, dtype=torch.float64)
        return self.tangent(rest.expand(*self.energy(rest).shape, 3, 3))

    def rest_stress(self, H: Tensor) -> Tensor:
        """Return the stress of small strains, A(0) : H, (..., 3, 3) [-]."""
        pressure = self.lam * trace(H)
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        return with_axes(self.mu, 2) * (H + H.mT) + pressure[..., None, None] * eye

    @property
    def has_residual_stress(self) -> bool:
        """True if `residual_stress` is not zero."""
        return False

    def residual_stress(self, H: Tensor) -> Tensor:
        """Return P(0) over E, (..., 3, 3) [-], at the points of H (..., 3, 3)."""
        return torch.zeros_like(H)

    @property
    def moduli_at_rest(self) -> tuple[Tensor, ...]:
        """Shear modulus and first Lame parameter at rest over Young's modulus [-]."""
        return self.mu, self.lam

    @property
    def largest_poisson_ratio(self) -> float:
        """Largest Poisson's ratio at rest of all cells and parameters [-]."""
        return max(float(law.poisson_ratio.max()) for law in self._at_ends)

    @property
    def _is_nearly_incompressible(self) -> bool:
        return self.largest_poisson_ratio > NEARLY_INCOMPRESSIBLE

    @property
    def _at_ends(self) -> list[Self]:
        """The law at each combination of the ends of its ranges."""
        ends = product(*self.parameter_ranges.values())
        return [self.with_parameters(torch.tensor([end], dtype=torch.float64)) for end in ends]

    @property
    def young_at_rest(self) -> float:
        """Young's modulus at rest, see `Scalable`; over E, or in the unit of the moduli.

        With fibres it is that of the average over all directions, see `FibreReinforced.mu`.
        """
        middles = [[ends.middle for ends in self.parameter_ranges.values()]]
        law = self.with_parameters(torch.tensor(middles, dtype=torch.float64))
        young = float(law._technical_moduli[0].mean())
        if not 0 < young < math.inf:
            raise ValueError(f"Young's modulus at rest = {young} must be above 0")
        return young

    def normalised(self) -> Self:
        """Return the law with E at rest = 1; itself if its moduli are over E by definition."""
        return self

    def compressible(self) -> Self:
        """Return the law with Poisson's ratio 0 at rest if it is above `NEARLY_INCOMPRESSIBLE`.

        A ratio or bulk modulus that is a range or a field stays.
        """
        return self._changed({key: part.compressible() for key, part in self.parts.items()})

    @property
    def _technical_moduli(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """E, mu, K and nu at rest."""
        mu, lam = torch.broadcast_tensors(self.mu, self.lam)
        young = mu * (3 * lam + 2 * mu) / (lam + mu)
        return young, mu, self.bulk_modulus, self.poisson_ratio

    def describe_rest(self, young: Sequence[float]) -> str:
        """Return E, mu, K and nu at rest in words, for the ends of Young's modulus [Pa]."""
        words, unit = [], " Pa"
        columns = zip(*(law._technical_moduli for law in self._at_ends), strict=True)
        for name, values in zip(("E", "mu", "K", "nu"), columns, strict=True):
            ends = min(float(v.min()) for v in values), max(float(v.max()) for v in values)
            if name == "nu":
                young, unit = (1.0, 1.0), ""
            low, high = (f"{end * scale:.4g}" for end, scale in zip(ends, young, strict=True))
            words.append(f"{name} {f'= {low}' if low == high else f'from {low} to {high}'}{unit}")
        return ", ".join(words)

    def groups(self, count: int) -> "list[tuple[Material, Tensor]]":
        """Return laws of one class and the numbers of the cells of each, of a body of E cells."""
        return [(self, torch.arange(count))]


@dataclass(frozen=True)
class YoungPoissonMaterial(Material, Scalable):
    """Law that at rest is Hooke's: such laws can be swapped fairly.

    Attributes:
        poisson: Poisson's ratio at rest [-], in (-1, 0.5); or a range [low, high], of which each
            load has its own, or a field.
        young: Young's modulus at rest over that of the scene [-], of a body of several laws; or a
            range or a field.
    """

    ranged: ClassVar[tuple[str, ...]] = ("poisson", "young")
    dimensional: ClassVar[tuple[str, ...]] = ("young",)

    poisson: Constant = option("", above=-1.0, below=0.5)
    young: Constant = option("", default=1.0, above=0.0)

    def identity(self) -> dict[str, Any]:
        """Return class name and parameters; `young` is left out if it is that of the scene."""
        is_scene = isinstance(self.young, int | float) and self.young * self.unit == 1
        return identity_of(self, exclude=["young", "unit"] if is_scene else [])

    @property
    def mu(self) -> Tensor:
        return self.value("young") / (2.0 * (1.0 + self.value("poisson")))

    def compressible(self) -> Self:
        number = isinstance(self.poisson, int | float)
        return replace(self, poisson=0.0) if number and self._is_nearly_incompressible else self

    @property
    def lam(self) -> Tensor:
        nu = self.value("poisson")
        return self.value("young") * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


class BulkOrPoisson(Material, Scalable):
    """Law with the volumetric term bulk/2 (J - 1)^2 and a shear modulus at rest `mu`.

    In place of `bulk`, Poisson's ratio at rest may be given: K = 2 mu (1 + nu) / (3 (1 - 2 nu)).
    """

    bulk: Constant | None
    poisson: Constant | None

    def check_constants(self) -> None:
        if not 0 < (mu := float(self.mu)) < math.inf:
            names = ", ".join(name for name in self.dimensional if name != "bulk")
            raise ValueError(f"{names}: the shear modulus at rest = {mu:g} must be above 0")

    def __post_init__(self) -> None:
        if (self.bulk is None) == (self.poisson is None):
            given = "both are" if self.poisson is not None else "none is"
            raise ValueError(f"bulk or poisson must be given, and the other be null; {given}")
        super().__post_init__()

    @property
    def bulk_modulus(self) -> Tensor:
        if self.bulk is not None:
            return self.value("bulk")
        nu = self.value("poisson")
        return self.mu * (2 * (1 + nu) / (3 * (1 - 2 * nu)))

    @property
    def lam(self) -> Tensor:
        return self.bulk_modulus - 2 / 3 * self.mu

    def compressible(self) -> Self:
        number = isinstance(self.bulk if self.poisson is None else self.poisson, int | float)
        changes = number and self._is_nearly_incompressible
        return replace(cast("Any", self), bulk=None, poisson=0.0) if changes else self

    def normalised(self) -> Self:
        """Return the law with E at rest = 1; itself if a constant is a field, which is over E."""
        if any(isinstance(getattr(self, name), CellField) for name in self.ranged):
            return self
        return self.over(self.young_at_rest)

"""What a hyperelastic law is: an energy density of the displacement gradient, and what follows.

Laws take the displacement gradient H = F - I and not F: for |H| near 1e-10 the strain is lost in
the rounding of 1 + H, and with it the equilibrium of small loads. For the same reason no law forms
its stress as a difference of terms that cancel at rest.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from dpl.fem.identity import identity_of
from dpl.fem.materials.tensors import green_lagrange


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
    strains as unknowns. A law of the invariants (`InvariantBasedMaterial`) is compiled too.

    Attributes:
        ranged: Names of the constants that may be ranges [low, high]; their law must derive from
            `YoungPoissonMaterial`, whose moduli at rest are known for a batch.
    """

    ranged: ClassVar[tuple[str, ...]] = ()

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
        if self.is_batched:
            return torch.func.grad(lambda G: self.energy(G).sum())(H)
        gradient = torch.func.vmap(torch.func.grad(self.energy))
        return gradient(H.reshape(-1, 3, 3)).reshape(H.shape)

    def tangent(self, H: Tensor) -> Tensor:
        """Return dP/dF over E, (..., 3, 3, 3, 3) [-], indexed iJkL."""
        if self.has_response:
            return self.response(green_lagrange(H)).tangent(H)
        hessian = torch.func.vmap(torch.func.hessian(self.energy))
        return hessian(H.reshape(-1, 3, 3)).reshape(*H.shape, 3, 3)

    def identity(self) -> dict[str, Any]:
        """Return class name and parameters as plain data."""
        return identity_of(self)

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
        if self.is_batched:
            raise ValueError(
                f"{type(self).__name__}: a law with ranges must derive from YoungPoissonMaterial"
            )
        return self.tangent(torch.zeros(1, 3, 3, dtype=torch.float64))[0]

    @property
    def parameter_ranges(self) -> dict[str, tuple[float, float]]:
        """Ranges of the constants of which each load has values of its own, by name.

        A law with ranges has no moduli: it answers nothing before `with_parameters`.
        """
        values = {name: getattr(self, name) for name in self.ranged}
        return {name: tuple(v) for name, v in values.items() if isinstance(v, Sequence)}

    @property
    def is_batched(self) -> bool:
        """True if each member of a batch has constants of its own, see `with_parameters`."""
        return any(isinstance(getattr(self, name), Tensor) for name in self.ranged)

    def with_parameters(self, parameters: Tensor) -> Self:
        """Return the law with values in place of its ranges.

        Args:
            parameters: Values in the order of `parameter_ranges`, (B, P). With B > 1 each member
                of a batch has its own, and the law takes strains (B, E, Q, 3, 3).

        Raises:
            ValueError: The law has another number of ranges, or does not allow a value.
        """
        names = tuple(self.parameter_ranges)
        if parameters.shape[-1] != len(names):
            raise ValueError(f"parameters: {type(self).__name__} has ranges of {list(names)}")
        if not names:
            return self
        law: Any = self  # a dataclass if it has ranges
        if not torch.compiler.is_compiling():  # a traced graph has no values to check
            if len(parameters) == 1:
                return replace(law, **dict(zip(names, parameters[0].tolist(), strict=True)))
            for extreme in (parameters.amin(0), parameters.amax(0)):
                self.with_parameters(extreme[None])
        # beside cells and points, so that numbers of a point, (B, E, Q), take their own
        columns = parameters.T[..., None, None]
        return replace(law, **dict(zip(names, columns, strict=True)))

    def __post_init__(self) -> None:
        """Check the constants of a dataclass, and both ends of its ranges.

        Raises:
            ValueError: The law does not allow a value, or a range is none.
        """
        if self.is_batched:
            return
        ranges = self.parameter_ranges
        for name, ends in ranges.items():
            if len(ends) != 2 or not ends[0] < ends[1]:
                raise ValueError(
                    f"{name} = {list(ends)} must be a range [low, high], low below high"
                )
            object.__setattr__(self, name, tuple(map(float, ends)))
        if not ranges:
            self.check_constants()
            return
        for corner in product(*ranges.values()):
            self.with_parameters(torch.tensor([corner], dtype=torch.float64))

    def check_constants(self) -> None:
        """Check the values of the constants.

        Raises:
            ValueError: The law does not allow a value.
        """


@dataclass(frozen=True)
class YoungPoissonMaterial(Material):
    """Law that at rest is Hooke's, with Young's modulus 1: such laws can be swapped fairly.

    Attributes:
        poisson: Poisson's ratio at rest [-], in (-1, 0.5); or a range [low, high], of which each
            load has its own.
    """

    ranged: ClassVar[tuple[str, ...]] = ("poisson",)

    poisson: float | Sequence[float]

    def check_constants(self) -> None:
        """See `Material.check_constants`."""
        if not -1.0 < self._one < 0.5:
            raise ValueError(
                f"poisson = {self.poisson} must lie between -1 and 0.5 (both excluded)"
            )

    @property
    def mu(self) -> float:
        """Shear modulus over Young's modulus [-]."""
        return 1.0 / (2.0 * (1.0 + self._one))

    @property
    def lam(self) -> float:
        """First Lame parameter over Young's modulus [-]."""
        return self._one / ((1.0 + self._one) * (1.0 - 2.0 * self._one))

    @property
    def bulk(self) -> float:
        """Bulk modulus over Young's modulus [-]."""
        return self.lam + 2 / 3 * self.mu

    @property
    def _one(self) -> float:
        """Poisson's ratio; (B, 1, 1) of a batch, which goes through the same arithmetic.

        Raises:
            ValueError: It is a range.
        """
        if isinstance(self.poisson, Sequence):
            raise ValueError(
                f"poisson = {list(self.poisson)} is a range; choose a value with "
                "Problem.with_parameters, or give Load.parameters for each load"
            )
        return self.poisson


def check_moduli(name: str, shear: float, bulk: float, constants: Iterable[float]) -> None:
    """Check the constants of a law, and the moduli at rest that follow.

    Raises:
        ValueError: A constant is no finite number, or the shear modulus, called `name`, or the bulk
            modulus is not above 0.
    """
    if not 0 < shear < math.inf:
        raise ValueError(f"{name} = {shear} must be above 0: it is the shear modulus at rest")
    if not 0 < bulk < math.inf:
        raise ValueError(f"bulk = {bulk} must be above 0")
    if not all(math.isfinite(constant) for constant in constants):
        raise ValueError(f"moduli = {list(constants)} must be finite numbers")

"""Criterion of equilibrium: the relative residual and the bound of its rounding error."""

from functools import cached_property, reduce

import torch
from torch import Tensor

from dpl.fem.assembly.tensor_assembly import TensorAssembly

FAINT = 1e-292  # largest force below which arithmetic rounds to an absolute precision [-]


class EquilibriumCriterion(TensorAssembly):
    """Body with the criterion of equilibrium that all solvers share."""

    def acting(self, force: Tensor) -> Tensor:
        """Return a force (B, N, D) [-] at free degrees of freedom, where it has an effect.

        At fixed ones the result is 0, or NaN where the force is not finite.
        """
        return force * self.free

    def relative_residual_of(self, internal: Tensor, force: Tensor) -> Tensor:
        """Return ||R_free|| / ||f||, (B,) [-], the criterion of equilibrium of all solvers.

        ||f|| is the norm of the forces on free degrees of freedom. Forces on fixed ones do no
        work and change no displacement, so they do not count. Where supports are moved, reactions
        do work: ||f|| is then at least the norm of the reactions on the degrees of freedom whose
        prescribed displacement is not 0. Reactions of supports that are not moved never count.
        Under follower loads ||f|| is at least the norm of their nodal forces on the body at rest,
        a measure that does not change with the displacement.

        Norms are taken of multiples of the largest force, so that no square underflows or
        overflows. Without forces the result is ||R_free|| itself. It is NaN for a force that is
        not finite, also on fixed degrees of freedom, and for a force whose largest entry is below
        `FAINT`, since its residual cannot be computed.

        Source: OptiStruct 2020, Nonlinear Convergence Criteria (its relative error in loads counts
        "nodal reactions due to specified displacements").

        Args:
            internal: f_int, (B, N, D) [-].
            force: f, (B, N, D) [-].
        """
        return self._measured(internal, force)[0]

    def is_equilibrium(
        self, displacement: Tensor, internal: Tensor, force: Tensor, tol: float
    ) -> Tensor:
        """Return True where the relative residual is below tol or the roundoff bound, (B,)."""
        ratio, scale = self._measured(internal, force)
        return (ratio < tol) | (
            (ratio < 1e-4) & (ratio * scale <= self.roundoff_bound(displacement))
        )

    def _measured(self, internal: Tensor, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return `relative_residual_of` and the ||f|| that it is relative to, (B,) [-]."""
        loads = [self.acting(force).flatten(1)]
        if self.moved_supports:
            loads.append((internal * (self.prescribed != 0)).flatten(1))
        if self.follower_loads:
            at_rest = self.force_at_rest.reshape(-1, *self.shape)
            loads.append(self.acting(at_rest).flatten(1))
        unit = reduce(torch.maximum, [load.abs().amax(1) for load in loads])  # NaN if an entry is
        unit = torch.where(unit == 0, 1.0, unit)
        unit = torch.where((unit >= FAINT) & (unit < torch.inf), unit, torch.nan)
        size = reduce(torch.maximum, [(load / unit[:, None]).norm(dim=1) for load in loads])
        size = torch.where(size == 0, 1.0, size)
        residual = self.acting(internal - force).flatten(1)
        return (residual / unit[:, None]).norm(dim=1) / size, size * unit

    def roundoff_bound(self, displacement: Tensor) -> Tensor:
        """Return a bound of the rounding error of ||R_free||, (B,) [-].

        The bound follows from magnitudes: every nodal force is a sum of products of displacement,
        gradient, modulus and gradient. On slivers it exceeds any tolerance.
        """
        return self._rounding * displacement.abs().amax(dim=(1, 2))

    @cached_property
    def _rounding(self) -> Tensor:
        """Bound over the largest displacement, (1,) or (B,) [-]."""
        size = self.dN.norm(dim=-1)  # (E or 1, Q, A)
        terms = (self.dV[..., None] * size * size.sum(-1, keepdim=True)).sum(1)
        modulus = self.material.lam + 2 * self.material.mu
        terms = (modulus.to(terms) * terms[None])[..., None]  # (B or 1, E, A, 1)
        terms = terms.expand(-1, len(self.cells), -1, self.shape[1])
        summed = self._sum_at_nodes(terms)[..., 0]
        summed = torch.where(self.free.any(dim=1), summed, 0.0)
        return torch.finfo(torch.float64).eps * summed.norm(dim=1)

    @property
    def is_loaded_at_rest(self) -> bool:
        """True if u = 0 is no equilibrium without forces: moved supports, follower loads."""
        return self.moved_supports or bool(self.force_at_rest.any())

    @cached_property
    def moved_supports(self) -> bool:
        """True if a prescribed displacement is not zero."""
        return bool((self.prescribed != 0).any())

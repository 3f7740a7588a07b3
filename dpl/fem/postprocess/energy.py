"""Potential energy of a body under loads, its gradient and its scale, in batches."""

import warnings
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from dpl.fem.linear.interface import full_matrix
from dpl.fem.problem import Problem
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.solution import Load
from dpl.fem.solvers.stiffness_terms import StiffnessTerms

ENTRIES = 16_000  # entries of displacements per evaluation, so that strains fit into the cache
CACHE_SIZE = 1_000_000  # loads whose work is cached
STEP = 1e-5  # step of the displacement gradient in difference quotients of forces [-]


@dataclass(frozen=True, eq=False)
class RestStiffness:
    """Stiffness K(0) of a body at rest, assembled and factorised at the first use.

    Attributes:
        problem: The body.
    """

    problem: Problem

    @classmethod
    def of(cls, problem: Problem, known: "RestStiffness | None") -> "RestStiffness":
        """Return `known` if it belongs to the body, else a new object."""
        return known if known is not None and known.problem is problem else cls(problem)

    def product(self, field: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Return K(0) v, (B, N, D) [-], of a field v; zero at fixed degrees of freedom.

        K(0) of parameters (B, P) is a linear combination of a few matrices, see `StiffnessTerms`.
        """
        problem = self.problem
        if parameters is None or not problem.material.parameter_ranges:
            image = torch.zeros_like(field)
            image[:, problem.free] = (self._matrix @ field.detach()[:, problem.free].T).T
            return image
        law = problem.material.with_parameters(problem.law_parameters(parameters))
        terms, bodies = self._terms
        factors = terms.factors(law).to(field)
        parts = torch.stack([rest.product(field) for rest in bodies])
        image = torch.einsum("bk,kbnd->bnd", factors.expand(len(field), -1), parts)
        if problem.springs is not None:
            image = image + torch.where(problem.free, problem.springs.force(field), 0.0)
        return image

    @cached_property
    def _terms(self) -> "tuple[StiffnessTerms, list[RestStiffness]]":
        """Terms of K(0), and their bodies."""
        terms = StiffnessTerms.of(self.problem)
        return terms, [RestStiffness(body) for body in terms.bodies]

    def linear_strain_energy(self, force: Tensor, parameters: Tensor) -> Tensor:
        """Return f.K(0)^-1 f / 2, the strain energy of the linear solution, (B,) [-].

        The relative error is about 1e-3, because the value is used as a scale only. Results are
        cached by the hash of the force, since the forces of a data set recur every epoch.
        """
        problem, found = self._linear.problem, []
        for one, own in zip(force.cpu(), parameters.cpu().expand(len(force), -1), strict=True):
            linear = self._linear.with_parameters(own[None])
            right = problem.restrict(one - linear.problem.force_at_rest)
            key = hash(right.tobytes() + own.numpy().tobytes())
            if key not in self._works:
                if len(self._works) >= CACHE_SIZE:
                    self._works.clear()
                self._works[key] = float(right @ linear.factor.solve(right, 1e-3)) / 2
            found.append(self._works[key])
        return torch.tensor(found, dtype=force.dtype, device=force.device)

    @cached_property
    def _works(self) -> dict[int, float]:
        return {}

    @cached_property
    def _linear(self) -> LinearSolver:
        on_cpu = self.problem.points.device.type == "cpu"
        return LinearSolver(self.problem if on_cpu else self.problem.to("cpu"))

    @cached_property
    def _matrix(self) -> Tensor:
        problem, device = self._linear.problem, self.problem.points.device
        whole = full_matrix(problem.pattern, problem.stiffness_at_rest().numpy())
        rows, columns, values = map(torch.from_numpy, (whole.indptr, whole.indices, whole.data))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # sparse matrices of torch are in beta state
            return torch.sparse_csr_tensor(rows, columns, values, whole.shape, device=device)

    def __getstate__(self) -> dict[str, object]:
        """Return the state without matrix and factor."""
        return {"problem": self.problem}


def potential_energy(
    displacement: Tensor, load: Load, problem: Problem
) -> tuple[Tensor, Tensor, Tensor]:
    """Return W(u) - W(0) - f.u (B,), its gradient (B, N, D), and a mask of det F > 0 (B,).

    W includes the potential of follower loads, which must have one.
    """
    if not problem.has_potential:
        raise ValueError(
            "the follower pressure has no potential, because the edge of its surface is free; use "
            "another loss than energy"
        )
    force, own = load.force, load.parameters.expand(len(displacement), -1)
    body = problem.with_parameters(own)
    internal, volume = body.evaluate(displacement)
    slope = torch.where(problem.free, internal - force, 0.0)
    count = max(1, ENTRIES // displacement[0].numel())
    parts = zip(displacement.split(count), own.split(count), strict=True)
    strain = torch.cat([problem.with_parameters(nu).energy(part) for part, nu in parts])
    nothing = body.points.new_zeros(1, len(body.cells), 1, 3, 3)
    at_rest = (body.material.energy(nothing) * body.dV).sum((-2, -1))  # not always zero
    energy = strain - at_rest - (force * displacement).sum(dim=(1, 2))
    sound = (volume > 0) & energy.isfinite() & slope.flatten(1).isfinite().all(dim=1)
    return energy, slope, sound


def tangent_product(problem: Problem, displacement: Tensor, direction: Tensor) -> Tensor:
    """Return K(u) v on free degrees of freedom, (B, N, D) [-], by a central difference of forces.

    The error is about 1e-8 |K| |v|. This is faster than the tangent or automatic differentiation.
    """
    gradient_norm = problem.dN.abs().max() * direction.abs().amax(dim=(1, 2))
    length = (STEP / gradient_norm.clamp(min=torch.finfo(gradient_norm.dtype).tiny))[:, None, None]
    ahead = problem.evaluate(displacement + length * direction).internal
    behind = problem.evaluate(displacement - length * direction).internal
    return torch.where(problem.free, (ahead - behind) / (2 * length), 0.0)

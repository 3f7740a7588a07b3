"""The energy of a body under loads, its scale and its slopes, for many displacements at once."""

import warnings
from dataclasses import dataclass
from functools import cached_property

import torch
from scipy.sparse import csr_array
from torch import Tensor

from dpl.fem.linear.interface import full_matrix
from dpl.fem.problem import Problem
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.solution import Load

ENTRIES = 16_000  # numbers of a displacement at once: few enough for their strains to fit a cache
REMEMBERED = 1_000_000  # loads whose scale is kept
SPANNING = (0.0, 0.2, 0.4)  # Poisson's ratios whose K(0) span all others'
STEP = 1e-5  # of the displacement gradient, where differences of forces stand for the tangent [-]


@dataclass(frozen=True, eq=False)
class RestStiffness:
    """A body at rest, made once, when first asked for.

    Attributes:
        problem: The body.
    """

    problem: Problem

    @classmethod
    def of(cls, problem: Problem, known: "RestStiffness | None") -> "RestStiffness":
        """Return the rest of a body: the known one if that is its."""
        return known if known is not None and known.problem is problem else cls(problem)

    def product(self, field: Tensor, poisson: Tensor | None = None) -> Tensor:
        """Return K(0) v, (B, N, D) [-], of v (B, N, D); zero where held.

        At rest every law is Hooke's, K(0) = lambda K1 + mu K2 + springs: that of any Poisson's
        ratio is a sum of those of three.

        Args:
            field: v.
            poisson: Of the loads, (B, P) [-]; P = 0 if left out.
        """
        problem = self.problem
        if poisson is None or not poisson.shape[-1]:
            free, image = problem.free, torch.zeros_like(field)
            columns = field.detach()[:, free].T
            if field.device.type == "cpu":
                image[:, free] = torch.from_numpy(self._matrix @ columns.numpy()).T
            else:
                image[:, free] = (self._on_device @ columns).T
            return image
        law = problem.material.at(poisson.flatten())
        moduli = [torch.as_tensor(m).flatten().to(field) for m in (law.lam, law.mu)]
        moduli.append(torch.ones_like(moduli[0]))
        known = [(m.lam, m.mu, 1.0) for m in (problem.material.at(nu) for nu in SPANNING)]
        shares = torch.linalg.solve(field.new_tensor(known).T, torch.stack(moduli))  # (3, B)
        parts = torch.stack([rest.product(field) for rest in self._spanning])
        return torch.einsum("kb,kbnd->bnd", shares, parts)

    @cached_property
    def _spanning(self) -> "list[RestStiffness]":
        return [RestStiffness(self.problem.at(nu)) for nu in SPANNING]

    def work(self, force: Tensor, poisson: Tensor | None = None) -> Tensor:
        """Return f.K(0)^-1 f / 2, the work of f (B, N, D) on its linear answer, (B,) [-].

        To about 1e-3: it is a scale. One solve with a stored factor, on the processor, for a force
        that is new; those of a data set come again every epoch and are remembered by their hash.
        With Poisson's ratios (B, 1) of their own, the first time takes a factor for each.
        """
        problem, found = self._linear.problem, []
        poisson = force.new_zeros(1, 0) if poisson is None else poisson
        for one, own in zip(force.cpu(), poisson.cpu().expand(len(force), -1), strict=True):
            right = problem.restrict(one)
            key = hash(right.tobytes() + own.numpy().tobytes())
            if key not in self._works:
                if len(self._works) >= REMEMBERED:
                    self._works.clear()
                factor = self._linear.at(own[None]).factor
                self._works[key] = float(right @ factor.solve(right, 1e-3)) / 2
            found.append(self._works[key])
        return torch.tensor(found, dtype=force.dtype, device=force.device)

    @cached_property
    def _works(self) -> dict[int, float]:
        return {}

    def energy(self, poisson: Tensor) -> Tensor:
        """Return W(0), (1,) or (B,) [-], which is not zero for every law."""
        if not poisson.shape[-1]:
            return self._energy
        body = self.problem.at(poisson)
        nothing = body.points.new_zeros(1, 1, 1, 3, 3)
        volume = body.dV.expand(len(body.cells), -1).sum()
        return volume * body.material.energy(nothing).flatten().expand(len(poisson))

    @cached_property
    def _energy(self) -> Tensor:
        return self.problem.energy(self.problem.points.new_zeros(1, *self.problem.shape))

    @cached_property
    def _linear(self) -> LinearSolver:
        here = self.problem.points.device.type == "cpu"
        return LinearSolver(self.problem if here else self.problem.to("cpu"))

    @cached_property
    def _matrix(self) -> csr_array:
        problem = self._linear.problem
        rest = torch.zeros(1, *problem.shape, dtype=torch.float64)
        return full_matrix(problem.pattern, problem.linearise(rest).tangent[0].numpy())

    @cached_property
    def _on_device(self) -> Tensor:
        whole, device = self._matrix, self.problem.points.device
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch calls its sparse matrices a beta
            return torch.sparse_csr_tensor(
                torch.from_numpy(whole.indptr),
                torch.from_numpy(whole.indices),
                torch.from_numpy(whole.data),
                whole.shape,
                device=device,
            )

    def __getstate__(self) -> dict[str, object]:
        """Pickle without matrix and factor."""
        return {"problem": self.problem}


def potential_energy(
    displacement: Tensor, load: Load, problem: Problem, rest: RestStiffness
) -> tuple[Tensor, Tensor, Tensor]:
    """Return W(u) - W(0) - f.u, (B,) [-], its slope (B, N, D), and whether all det F > 0, (B,)."""
    force, own = load.force, load.poisson.expand(len(displacement), -1)
    internal, volume = problem.at(own).evaluate(displacement)
    slope = torch.where(problem.free, internal - force, 0.0)
    count = max(1, ENTRIES // displacement[0].numel())
    parts = zip(displacement.split(count), own.split(count), strict=True)
    strain = torch.cat([problem.at(nu).energy(part) for part, nu in parts]) - rest.energy(own)
    energy = strain - (force * displacement).sum(dim=(1, 2))
    sound = (volume > 0) & energy.isfinite() & slope.flatten(1).isfinite().all(dim=1)
    return energy, slope, sound


def tangent_product(problem: Problem, displacement: Tensor, direction: Tensor) -> Tensor:
    """Return K(u) v on free degrees of freedom, (B, N, D) [-], by a central difference of forces.

    Two evaluations, by compiled loops a quarter as long as the tangent and a thirtieth as long as a
    derivative of tensors; to about 1e-8 of |K| |v|.
    """
    steepness = problem.dN.abs().max() * direction.abs().amax(dim=(1, 2))
    length = (STEP / steepness.clamp(min=torch.finfo(steepness.dtype).tiny))[:, None, None]
    ahead = problem.evaluate(displacement + length * direction).internal
    behind = problem.evaluate(displacement - length * direction).internal
    return torch.where(problem.free, (ahead - behind) / (2 * length), 0.0)

"""K(0)^-1, the compliance of a body at rest: its factor, and the linear answer to a load."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import torch
from torch import Tensor

from dpl.fem.dofs import gather, scatter
from dpl.fem.linear.backends import make_backend, select_backend
from dpl.fem.linear.banded import BandedFactor
from dpl.fem.linear.interface import Backend, Factor
from dpl.fem.problem import Problem
from dpl.fem.solvers.corotational import CorotationalPreconditioner
from dpl.fem.solvers.solution import Load, Solution, check_force, check_tol, evaluate_solution

MAX_CLONES = 4  # bodies of other Poisson's ratios whose factors are kept


@dataclass(frozen=True, eq=False)
class LinearSolver:
    """The linear answer K(0)^-1 f: exact for infinitesimal loads, one solve with a stored factor.

    Attributes:
        problem: The body.
        tol: Residual ratio below which the answer counts as converged [-]; at least 1e-15, below 1.
        linear: Backend of the sparse solves, see `dpl.fem.linear.make_backend`.
    """

    problem: Problem
    tol: float = 1e-8
    linear: str = "auto"

    def __post_init__(self) -> None:
        """Check the tolerance.

        Raises:
            ValueError: It is out of range.
        """
        check_tol(self.tol)

    @cached_property
    def factor(self) -> Factor:
        """Factor of K(0)."""
        rest = torch.zeros(1, *self.problem.shape, dtype=torch.float64)
        values = self.problem.linearise(rest).tangent[0].numpy()
        return self._backend.factorise(values)

    @cached_property
    def corotational(self) -> CorotationalPreconditioner:
        """What turns the factor of K(0) with the nodes; in float32 where it is a band."""
        factor = self.factor
        rough = factor.to_float32() if isinstance(factor, BandedFactor) else factor
        return CorotationalPreconditioner(self.problem, rough)

    @cached_property
    def _backend(self) -> Backend:
        return backend_for(self.problem, self.linear, many_rhs=True)

    def at(self, poisson: Tensor | float) -> "LinearSolver":
        """Return the linear answer of the body of another Poisson's ratio, see `Problem.at`."""
        return self.of(self.problem.at(poisson))

    def of(self, problem: Problem) -> "LinearSolver":
        """Return the linear answer of a body that differs in Poisson's ratio only."""
        return self if problem is self.problem else cached_clone(self._clones, problem, self._clone)

    def _clone(self, problem: Problem) -> "LinearSolver":
        twin = replace(self, problem=problem)
        twin.__dict__["_backend"] = self._backend
        return twin

    @cached_property
    def _clones(self) -> "dict[Problem, LinearSolver]":
        return {}

    @cached_property
    def reference(self) -> "LinearSolver":
        """The linear answer of the reference body, see `Problem.reference`."""
        problem = self.problem.reference
        return self if problem is self.problem else self._clone(problem)

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the linear answer.

        Raises:
            ValueError: The force is none for this body, see `check_force`.
        """
        check_force(self.problem, load)
        start = time.perf_counter()
        pairs = zip(load.force, load.poisson.expand(len(load.force), -1), strict=True)
        answer = torch.stack([self.at(nu[None]).solve(force) for force, nu in pairs])
        seconds = (time.perf_counter() - start) / len(answer)
        yield evaluate_solution(self.problem, answer, load, self.tol, iterations=1, seconds=seconds)

    def solve(self, force: Tensor) -> Tensor:
        """Return K(0)^-1 f, (N, D) [-], for f (N, D) [-]; zero where held."""
        return scatter(self.factor.solve(gather(force, self.problem)), self.problem)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without the factor."""
        return {"problem": self.problem, "tol": self.tol, "linear": self.linear}


Twin = TypeVar("Twin")


def cached_clone(
    twins: dict[Problem, Twin], problem: Problem, make: Callable[[Problem], Twin]
) -> Twin:
    """Return what belongs to a problem, made if it is not there; the oldest leaves for it."""
    if problem not in twins:
        if len(twins) >= MAX_CLONES:
            twins.pop(next(iter(twins)))
        twins[problem] = make(problem)
    return twins[problem]


def backend_for(problem: Problem, name: str, *, many_rhs: bool = False) -> Backend:
    """Return the backend for a problem's tangents, or for one whose factor answers many loads."""
    motions = problem.near_null
    best = select_backend(name, problem.pattern, motions, many_rhs=many_rhs)
    return make_backend(problem.pattern, best, motions)

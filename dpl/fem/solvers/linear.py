"""Linear elastic solution K(0)^-1 f with one stored factor of K(0)."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import _lru_cache_wrapper, cached_property, lru_cache, partial
from itertools import islice
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from dpl.fem.linear.backends import BackendFactory, make_backend
from dpl.fem.linear.banded import BandedFactor
from dpl.fem.linear.interface import Array, Backend, Factor, SymmetricProduct
from dpl.fem.linear.krylov import Map, krylov_steps, smallest_ritz_value
from dpl.fem.problem import Problem
from dpl.fem.solvers.corotational import CorotationalPreconditioner
from dpl.fem.solvers.parity_factor import CondensedBody
from dpl.fem.solvers.solution import Load, Solution, check_force, check_tol, evaluate_solution
from dpl.fem.symmetry import SymmetryGroup, symmetries

MAX_CLONES = 4  # solvers of other parameters that are kept with their factors
DIFFERENCE = 1e-7  # largest change of u/L in a difference of forces [-]
ENOUGH, MAX_COUNT = 1e-3, 50  # relative residual and largest number of steps that are counted


@dataclass(frozen=True, eq=False)
class LinearSolver:
    """Linear elastic solution K(0)^-1 f, the limit of small loads: one solve with a stored factor.

    Attributes:
        problem: The body.
        tol: Relative residual below which a solution counts as converged [-]; at least 1e-15,
            below 1.
        linear: Backend of the sparse solves, see `dpl.fem.linear.make_backend`.
        parent: Solver of the same mesh with other parameters, whose backends are used.
        approximate: Factor of K(0) in the accuracy of float32, if there is one already.
    """

    problem: Problem
    tol: float = 1e-8
    linear: str | BackendFactory = "auto"
    parent: "LinearSolver | None" = field(default=None, repr=False)
    approximate: Factor | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        check_tol(self.tol)

    @cached_property
    def factor(self) -> Factor:
        """Factor of K(0)."""
        if self._twin:
            return self._twin.factor
        return self.backend.factorise(self.problem.stiffness_at_rest().numpy())

    @cached_property
    def corotational(self) -> CorotationalPreconditioner:
        """Preconditioner from `float32_factor`."""
        if self._twin:
            return self._twin.corotational
        return CorotationalPreconditioner(self.problem.discretisation, self.float32_factor)

    def count_iterations(self, displacement: Tensor) -> int:
        """Return the conjugate gradient steps for K(u), u (1, N, D), with the corotated factor.

        They reduce a random right-hand side to `ENOUGH`; more than `MAX_COUNT` are not counted.
        """
        right = np.random.default_rng(0).standard_normal(self.problem.pattern.size)
        steps = islice(krylov_steps(*self._preconditioned(displacement), right), MAX_COUNT)
        enough = ENOUGH * np.linalg.norm(right)
        small = (k for k, step in enumerate(steps) if np.linalg.norm(step.residual) <= enough)
        return next(small, MAX_COUNT)

    def smallest_ritz_value(self, displacement: Tensor, internal: Tensor | None = None) -> float:
        """Return the smallest Ritz value of the corotated inverse times K(u), u (1, N, D) [-].

        `internal` is the internal force f_int at u, (1, N, D), if known. Differences of f_int
        replace products with K(u), whose assembly takes as long as eight of them.
        """
        problem, apply = self.problem, self.corotational.at(displacement).apply
        if not problem.has_potential:  # K is the symmetric part of the derivative of f_int
            return smallest_ritz_value(*self._preconditioned(displacement), problem.pattern.size)
        rest = (problem.evaluate(displacement).internal if internal is None else internal)[0]

        def product(x: Array) -> Array:
            step = DIFFERENCE / float(np.abs(x).max())
            moved = problem.evaluate(displacement + step * problem.extend(x)).internal[0]
            return problem.restrict(moved - rest) / step

        return smallest_ritz_value(product, apply, problem.pattern.size)

    def _preconditioned(self, displacement: Tensor) -> tuple[Map, Map]:
        """Return the products with the tangent and with its corotated preconditioner."""
        values = self.problem.linearise(displacement).tangent[0].numpy()
        product = SymmetricProduct(self.problem.pattern, values)
        return product, self.corotational.at(displacement).apply

    @cached_property
    def condensed(self) -> CondensedBody:
        """K(0)^-1 of the body for all parameters of its law."""
        if self.parent:
            return self.parent.condensed
        return CondensedBody.of(self.problem, self.symmetries)

    @cached_property
    def float32_factor(self) -> Factor:
        """Approximate factor of K(0): accurate to 1e-4, or in full if it is not banded.

        Dense blocks of a nested condensation solve ten times as fast as bands. They take longer to
        compute: where those of a few parameters do not serve the others, these have bands.
        """
        if self._twin:
            return self._twin.float32_factor
        if self.approximate is not None:
            return self.approximate
        reference = (self.parent or self).reference
        if not isinstance(reference.factor, BandedFactor):
            return self.factor
        if not self.condensed.terms.has_steps:
            return self.condensed.factor(self.problem.material)
        if self.problem is reference.problem:
            one = CondensedBody.of(self.problem, self.symmetries)
            return one.factor(self.problem.material)
        factor = cast(BandedFactor, self.factor)
        return replace(factor, storage=factor.storage.astype(np.float32))

    @property
    def _twin(self) -> "LinearSolver | None":
        """The parent if it has the same K(0): only follower loads or moved supports differ."""
        parent = self.parent
        return parent if parent and parent.problem.material is self.problem.material else None

    @cached_property
    def symmetries(self) -> SymmetryGroup:
        """Symmetries of the body, which no parameters of the law change."""
        return self.parent.symmetries if self.parent else symmetries(self.problem)

    @cached_property
    def backend(self) -> Backend:
        """Backend of K(0), whose factor solves for many loads."""
        if self.parent:
            return self.parent.backend
        problem = self.problem
        return make_backend(problem.pattern, self.linear, problem.near_null, many_rhs=True)

    @cached_property
    def tangent_backend(self) -> Backend:
        """Backend of the tangents far from rest, each of which is factorised for few solves."""
        if self.parent:
            return self.parent.tangent_backend
        return make_backend(self.problem.pattern, self.linear, self.problem.near_null)

    def with_parameters(self, parameters: Tensor) -> "LinearSolver":
        """Return the solver of `Problem.with_parameters`; the last `MAX_CLONES` are kept."""
        problem = self.problem.with_parameters(parameters)
        return self if problem is self.problem else self._with_problem(problem)

    def forget_clones(self) -> None:
        """Drop the solvers of other parameters, so that their factors are computed again."""
        self._with_problem.cache_clear()

    @cached_property
    def reference(self) -> "LinearSolver":
        """The linear solver of the reference body, see `Problem.reference`."""
        problem = self.problem.reference
        return self if problem is self.problem else self._with_problem(problem)

    @cached_property
    def _with_problem(self) -> "_lru_cache_wrapper[LinearSolver]":
        change = partial(replace, self, parent=self, approximate=None)
        return lru_cache(MAX_CLONES)(lambda problem: change(problem=problem))

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the linear solution; a force that does not fit the body is a ValueError."""
        check_force(self.problem, load)
        start, members = time.perf_counter(), load.unbatch()
        u = torch.stack([self.with_parameters(f.parameters).solve(f.force[0]) for f in members])
        seconds = (time.perf_counter() - start) / len(u)
        yield evaluate_solution(self.problem, u, load, self.tol, iterations=1, seconds=seconds)

    def solve(self, force: Tensor) -> Tensor:
        """Return the linear solution, (N, D) [-], under a force (N, D) [-].

        It has the prescribed displacements of the supports, and follower loads are dead loads on
        the body at rest.
        """
        problem = self.problem
        return problem.prescribed + self.solve_force(force - problem.support_force)

    def solve_force(self, force: Tensor) -> Tensor:
        """Return K(0)^-1 f, (N, D) [-], of a force alone; zero at supports."""
        return self.problem.extend(self.factor.solve(self.problem.restrict(force)))

    def __getstate__(self) -> dict[str, object]:
        """Pickle without the factor, but with blocks of `condensed` that take long to compute."""
        kept = ("problem", "tol", "linear", "condensed")
        return {name: vars(self)[name] for name in kept if name in vars(self)}


@runtime_checkable
class ReferenceSolver(Protocol):
    """Solver of a scene. Data sets and comparisons hold its solutions.

    Any class with these attributes can be the solver of a scene. The configuration calls it with
    the keyword `problem`. A load brings its own parameters where the law has ranges:
    `problem.with_parameters(load.parameters)` is its body.
    """

    @property
    def problem(self) -> Problem:
        """Body."""

    @property
    def tol(self) -> float:
        """Relative residual below which a solution counts as converged [-]."""

    @property
    def linear_solver(self) -> LinearSolver:
        """Linear solver with the factor of K(0) that the whole scene shares."""

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the solutions of the iterations; the last one is the result."""

    def identity(self) -> dict[str, Any]:
        """Return the options that determine the solutions, as plain data."""

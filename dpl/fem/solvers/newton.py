"""Newton-Raphson on the nodal equilibrium f_int(u) = f, with load steps where it must."""

import math
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.dofs import gather, scatter
from dpl.fem.linear.backends import select_backend
from dpl.fem.linear.interface import Backend, Factor, SingularMatrix
from dpl.fem.problem import Problem
from dpl.fem.solvers.factor_reuse import FactorCache, negative_pivots_at
from dpl.fem.solvers.linear import LinearSolver, backend_for, cached_clone
from dpl.fem.solvers.solution import Load, Solution, Status, check_force, check_steps, run_lockstep

CAREFUL = 2.0**-4  # load step from which on the end of the path may be near: full accuracy


@dataclass(frozen=True, eq=False)
class Newton:
    """Newton-Raphson that never accepts an inverted element, with load steps where it must.

    Full steps on the whole load first; a step that would bring det F at a quadrature point below
    `min_detF_ratio` of its value is shortened until it does not. (No line search on the residual
    norm: on the way to large rotations it rises a hundredfold before it falls.) Where that does not
    converge, the load is applied in steps, each half the one that failed, twice the one that
    succeeded; intermediate states need only `intermediate_tol`.

    An answer whose tangent has negative pivots is in balance but no minimum of the energy, a
    straight column beyond its critical load, for one: its status says so. The tangent at the
    answer is factorised only if the last one on the way had some or may have had, so that an answer
    within 1e-4 of a critical load may pass.

    Source: Wriggers (2008), Nonlinear Finite Element Methods, sections 5.1 and 5.3.

    Attributes:
        problem: The body.
        tol: Residual ratio ||R_free|| / ||f|| of an answer [-], see
            `Problem.relative_residual_of`; at least 1e-15, below 1. Where
            rounding does not allow it, on very thin cells, an answer whose residual no longer falls
            counts as converged, with a warning.
        max_iter: Iterations per load step before it is halved.
        max_total_iter: Iterations in all before a load is given up.
        min_load_step: Load step, as a part of the load, below which to give up [-].
        intermediate_tol: Residual ratio at intermediate load factors [-].
        min_detF_ratio: Part of det F that one step may leave of the smallest one [-].
        linear: Backend of the sparse solves, see `dpl.fem.linear.make_backend`.
        mixed_integration: Let the strains at the quadrature points be unknowns of their own
            (Magisano, Leonetti, Garcea 2017), for laws that can: fewer iterations and far larger
            steps.
        factor_reuse_tol: Residual ratio below which the last factor, as preconditioner of conjugate
            gradients on the new tangent, stands for a new one [-]; 0: a factor for every tangent.
        corotational: Let the factor of K(0), rotated with the nodes, stand for those of tangents
            while conjugate gradients with it are short. Whether an answer is stable is then known
            only where they were not.
    """

    problem: Problem
    tol: float = 1e-8
    max_iter: int = 15
    max_total_iter: int = 400
    min_load_step: float = 2.0**-10
    intermediate_tol: float = 1e-2
    min_detF_ratio: float = 0.2
    linear: str = "auto"
    mixed_integration: bool = True
    factor_reuse_tol: float = 0.1
    corotational: bool = False

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: An attribute is out of range, or the backend is not there.
        """
        check_steps(self, parts=("intermediate_tol", "min_detF_ratio", "min_load_step"))
        select_backend(self.linear)

    def iterate(self, load: Load, *, guess: Tensor | None = None) -> Iterator[Solution]:
        """Yield the state before the first update and after each one.

        Members of a batch are solved one by one, in step; one that has ended repeats its end. A
        member that ends without an answer ends with its last equilibrium under a part of the load.

        Args:
            load: What acts.
            guess: Where to start, (B, N, D) [-]; zero if left out, and where it is inverted.

        Raises:
            ValueError: The force is none for this body, see `check_force`.
        """
        check_force(self.problem, load)
        acting, own = self.problem.acting(load.force), load.poisson.expand(len(load.force), -1)
        guesses = [None] * len(own) if guess is None else guess.split(1)
        yield from run_lockstep(
            [
                self.at(nu[None])._member(force[None], start)
                for force, nu, start in zip(acting, own, guesses, strict=True)
            ]
        )

    def replace(self, **changes: Any) -> "Newton":
        """Return the solver with other attributes, those of its K(0) excepted: it keeps that."""
        other = replace(self, **changes)
        other.__dict__["linear_solver"] = self.linear_solver
        return other

    def at(self, poisson: Tensor | float) -> "Newton":
        """Return the solver of the body of another Poisson's ratio, see `Problem.at`.

        It has a K(0) of its own to factorise; those of the last few are kept.
        """
        problem = self.problem.at(poisson)
        return self if problem is self.problem else cached_clone(self._clones, problem, self._clone)

    def _clone(self, problem: Problem) -> "Newton":
        twin = replace(self, problem=problem)
        twin.__dict__["_backend"] = self._backend
        twin.__dict__["linear_solver"] = self.linear_solver.of(problem)
        return twin

    @cached_property
    def _clones(self) -> "dict[Problem, Newton]":
        return {}

    def _member(self, force: Tensor, guess: Tensor | None) -> Iterator[Solution]:
        """Yield the states under one load (1, N, D)."""
        problem = self.problem
        count = _Count(
            FactorCache(self.linear_solver, self.factorise, corotational=self.corotational)
        )
        state = base = self._rest(force)
        guessed = guess is not None and bool(guess.any())
        guessed &= bool(force.any()) or problem.moved_supports
        if guess is not None and guessed:
            held = torch.where(problem.free, guess, problem.prescribed)
            start = self._state(held, torch.zeros_like(force))
            state, guessed = (start, True) if start.volume_ratio > 0 else (base, False)
        count.known, count.guessed, step = 0.0, guessed, 1.0
        yield self._report(state, force, count)
        while not self._balanced(state, force, 1.0, self.tol):
            target = min(count.known + step, 1.0)
            whole = target == 1.0
            tol = self.tol if whole or step < CAREFUL else self.intermediate_tol
            for iterate in self._correct(state, force, target, tol, count):
                state = iterate
                yield self._report(state, force, count)
            if self._balanced(state, force, target, tol):
                base, count.known, step = state, target, 2 * step
            else:  # a guess that failed costs no load step
                step = step if count.guessed else (target - count.known) / 2
                state, count.guessed = base, False
            lost = step < self.min_load_step
            spent = count.iterations >= self.max_total_iter
            if lost or (spent and not self._balanced(state, force, 1.0, self.tol)):
                end = Status.NO_VALID_EQUILIBRIUM if lost else Status.NOT_CONVERGED
                yield self._report(base, force, count, end)
                return
            ahead = min(count.known + step, 1.0) - count.known
            state = state._replace(jump=ahead * problem.prescribed[None])

    def _correct(
        self, state: "_State", force: Tensor, target: float, tol: float, count: "_Count"
    ) -> Iterator["_State"]:
        """Yield iterates under `target` times a load until they balance it or cannot go on."""
        before = float("nan")
        count.factors.invalidate()
        for _ in range(self.max_iter):
            ratio = self._ratio(state, force, target)
            if not ratio < self.factor_reuse_tol:
                count.factors.invalidate()
            try:
                update = self._update(state, target * force, count, self._forcing(ratio, before))
            except SingularMatrix:
                return
            count.iterations += 1
            stepped = self._stepped(state, update, shorten=not count.guessed)
            if stepped is None:
                return
            state = stepped._replace(before=ratio)
            yield state
            if self._balanced(state, force, target, tol) or count.iterations >= self.max_total_iter:
                return
            before = ratio

    def _forcing(self, ratio: float, before: float) -> float:
        """Return the relative residual that a linear solve may leave.

        As much as does not slow Newton down; `before` is the residual ratio an iteration ago, NaN
        in the first one.

        Source: Eisenstat, Walker (1996), SIAM J. Sci. Comput. 17, choice 2.
        """
        enough = 0.1 * self.tol / ratio if ratio > 0 else 0.0
        unknown = 1e-3 if self.corotational else 0.0
        earned = 0.01 * (ratio / before) ** 2 if before > 0 else unknown
        return max(1e-12, enough, min(1e-3, earned))

    def _update(self, state: "_State", force: Tensor, count: "_Count", rtol: float) -> Tensor:
        """Return the full Newton step (1, N, D) under a force, supports included.

        Raises:
            SingularMatrix: The tangent has no factor.
        """
        problem, u = self.problem, state.displacement
        if not u.any():
            right = self._right(state, force, state.internal)
            return scatter(count.factors.at_rest(right, rtol), problem)[None] + state.jump
        system = problem.linearise(u, state.gap)
        if not system.valid:
            system = problem.linearise(u)
        right = self._right(state, force, system.force)
        step = count.factors.solve(system.tangent[0].numpy(), u, right, rtol)
        return scatter(step, problem)[None] + state.jump

    def _right(self, state: "_State", force: Tensor, internal: Tensor) -> NDArray[np.float64]:
        """Return what the step has to balance, (n,)."""
        right = force - internal
        if state.jump.any():
            right = right - self.problem.tangent_product(state.displacement, state.jump)
        return gather(right[0], self.problem)

    def _stepped(self, state: "_State", update: Tensor, *, shorten: bool) -> "_State | None":
        """Return the state after the longest of the steps 1, 1/2, 1/4, ... that inverts nothing.

        Only the whole one unless it is to `shorten`: a guess is good, or it is given up.
        """
        floor = self.min_detF_ratio * min(float(state.volume_ratio), 1.0)
        for length in (0.5 ** np.arange(10 if shorten else 1)).tolist():
            jump = (1 - length) * state.jump
            end = self._state(state.displacement + length * update, jump)
            if end.volume_ratio > floor:
                if self.mixed_integration and self.problem.supports_mip:
                    return end._replace(
                        gap=self.problem.update_strain_gap(state.gap, length, update)
                    )
                return end
        return None

    @cached_property
    def linear_solver(self) -> LinearSolver:
        """The linear answer, with the factor that every first step from zero uses."""
        return LinearSolver(self.problem, self.tol, self.linear)

    @cached_property
    def _backend(self) -> Backend:
        return backend_for(self.problem, self.linear)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without factors."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def _rest(self, force: Tensor) -> "_State":
        """Return the state of the body at rest, which needs no evaluation."""
        zero, one = torch.zeros_like(force), torch.ones(1, dtype=force.dtype)
        return _State(zero, zero, one, self.problem.prescribed[None], None, {})

    def _state(self, displacement: Tensor, jump: Tensor, gap: Any = None) -> "_State":
        return _State(displacement, *self.problem.evaluate(displacement), jump, gap, {})

    def _ratio(self, state: "_State", force: Tensor, target: float) -> float:
        """Return ||R_free|| / ||f|| under `target` times a load, evaluated once."""
        if target not in state.ratios:
            ratio = self.problem.relative_residual_of(state.internal, target * force)
            state.ratios[target] = float(ratio)
        return state.ratios[target]

    def _balanced(self, state: "_State", force: Tensor, target: float, tol: float) -> bool:
        if not state.volume_ratio > 0 or state.jump.any():
            return False
        if (ratio := self._ratio(state, force, target)) < tol:
            return True
        u, internal = state.displacement, state.internal
        stuck = 0.1 * state.before < ratio < 1e-4
        return stuck and bool(self.problem.is_equilibrium(u, internal, target * force, tol))

    def _report(
        self, state: "_State", force: Tensor, count: "_Count", end: Status | None = None
    ) -> Solution:
        balanced, pivots = end is None and self._balanced(state, force, 1.0, self.tol), -1
        if balanced:
            if (ratio := self._ratio(state, force, 1.0)) >= self.tol:
                warnings.warn(
                    f"||R||/||f|| = {ratio:.1e} and not {self.tol:g}: rounding allows no less on "
                    "this body (very thin cells, moduli far apart?)",
                    stacklevel=2,
                )
            pivots = count.factors.negative_pivots(state.displacement)
            end = Status.UNSTABLE if pivots > 0 else Status.CONVERGED
        elif end is None:
            end = Status.NOT_CONVERGED
        factor = 1.0 if balanced else count.known
        return Solution(
            displacement=state.displacement,
            residual=torch.tensor([self._ratio(state, force, 1.0)], dtype=force.dtype),
            volume_ratio=state.volume_ratio,
            status=torch.tensor([int(end)]),
            negative_pivots=torch.tensor([pivots]),
            iterations=torch.tensor([count.iterations]),
            factorisations=torch.tensor([count.factors.count]),
            load_factor=torch.tensor([factor], dtype=force.dtype),
            seconds=torch.tensor([time.perf_counter() - count.start], dtype=torch.float64),
            from_guess=torch.tensor([count.guessed]),
        )

    def factorise(self, tangent: NDArray[np.float64]) -> Factor:
        """Return the factor of a tangent's entries (nnz,), see `Backend.factorise`."""
        return self._backend.factorise(tangent)

    def negative_pivots(self, displacement: Tensor) -> int:
        """Return the negative eigenvalues of the tangent at (1, N, D); 1 where it is singular.

        Conjugate gradients do not count them: 1 stands for some, -1 for not known.
        """
        return negative_pivots_at(self.problem, self.factorise, displacement)


class _State(NamedTuple):
    """An iterate, evaluated once, and how far its supports have yet to move."""

    displacement: Tensor
    internal: Tensor
    volume_ratio: Tensor
    jump: Tensor
    gap: Any
    ratios: dict[float, float]
    before: float = math.inf  # residual ratio that the step came from


@dataclass
class _Count:
    """What one load has cost so far, and what is known of it."""

    factors: FactorCache
    iterations: int = 0
    known: float = 0.0
    guessed: bool = False  # whether the guess, if there was one, has not failed
    start: float = field(default_factory=time.perf_counter)

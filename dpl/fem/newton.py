"""Newton-Raphson on the nodal equilibrium f_int(u) = f, and the linear answer it starts with."""

import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.band import Cholesky
from dpl.fem.krylov import CGFactor, conjugate_gradients, lowest
from dpl.fem.linear import Backend, Factor, SingularMatrix, backend, chosen
from dpl.fem.problem import Problem
from dpl.fem.solution import Load, Solution, Status, check_force, in_step, judge
from dpl.fem.sparse import SymmetricProduct
from dpl.fem.turned import Turned, Turning


@dataclass(frozen=True, eq=False)
class Linear:
    """The linear answer K(0)^-1 f: exact for infinitesimal loads, one solve with a stored factor.

    Attributes:
        problem: The body.
        tol: Residual ratio below which the answer counts as converged [-].
        linear: Backend of the sparse solves, see `dpl.fem.linear.backend`.
    """

    problem: Problem
    tol: float = 1e-8
    linear: str = "auto"

    @cached_property
    def factor(self) -> Factor:
        """Factor of K(0)."""
        rest = torch.zeros(1, *self.problem.shape, dtype=torch.float64)
        values = self.problem.linearise(rest).tangent[0].numpy()
        return self._backend.factorise(values)

    @cached_property
    def turning(self) -> Turning:
        """What turns the factor of K(0) with the nodes; in float32 where it is a band."""
        factor = self.factor
        rough = factor.rounded() if isinstance(factor, Cholesky) else factor
        return Turning(self.problem, rough)

    @cached_property
    def _backend(self) -> Backend:
        return _backend_of(self.problem, self.linear, lasting=True)

    def at(self, poisson: Tensor | float) -> "Linear":
        """Return the linear answer of the body of another Poisson's ratio, see `Problem.at`."""
        problem = self.problem.at(poisson)
        return self if problem is self.problem else _kept(self._twins, problem, self._twin)

    def _twin(self, problem: Problem) -> "Linear":
        twin = replace(self, problem=problem)
        twin.__dict__["_backend"] = self._backend
        return twin

    @cached_property
    def _twins(self) -> "dict[Problem, Linear]":
        return {}

    @cached_property
    def reference(self) -> "Linear":
        """The linear answer of the reference body, see `Problem.reference`."""
        problem = self.problem.reference
        return self if problem is self.problem else self._twin(problem)

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the linear answer.

        Raises:
            ValueError: The force is none for this body, see `check_force`.
        """
        check_force(self.problem, load)
        start = time.perf_counter()
        pairs = zip(load.force, load.poisson.expand(len(load.force), -1), strict=True)
        answer = torch.stack([self.at(nu[None]).respond(force) for force, nu in pairs])
        seconds = (time.perf_counter() - start) / len(answer)
        yield judge(self.problem, answer, load, self.tol, iterations=1, seconds=seconds)

    def respond(self, force: Tensor) -> Tensor:
        """Return K(0)^-1 f, (N, D) [-], for f (N, D) [-]; zero where held."""
        return scatter(self.factor.solve(gather(force, self.problem)), self.problem)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without the factor."""
        return {"problem": self.problem, "tol": self.tol, "linear": self.linear}


TWINS = 4  # bodies of other Poisson's ratios whose factors are kept
DOUBT = 0.05  # eigenvalue, relative to a factor nearby, below which a tangent is examined
PATIENCE = 8  # conjugate gradient steps with the factor of another tangent, then its own
TURNS = 16  # of the same with K(0)'s, turned
CAREFUL = 2.0**-4  # load step from which on the end of the path may be near: full accuracy


@dataclass(frozen=True, eq=False)
class Newton:
    """Newton-Raphson that never accepts an inverted element, with load steps where it must.

    Full steps on the whole load first; a step that would bring det F at a quadrature point below
    `keep` of its value is shortened until it does not. (No line search on the residual norm: on
    the way to large rotations it rises a hundredfold before it falls.) Where that does not
    converge, the load is applied in steps, each half the one that failed, twice the one that
    succeeded; intermediate states need only `loose`.

    An answer whose tangent has negative pivots is in balance but no minimum of the energy, a
    straight column beyond its critical load, for one: its status says so. The tangent at the
    answer is factorised only if the last one on the way had some or may have had, so that an answer
    within 1e-4 of a critical load may pass.

    Source: Wriggers (2008), Nonlinear Finite Element Methods, sections 5.1 and 5.3.

    Attributes:
        problem: The body.
        tol: Residual ratio ||R_free|| / ||f|| of an answer [-].
        max_iter: Iterations per load step before it is halved.
        budget: Iterations in all before a load is given up.
        smallest_step: Load step, as a part of the load, below which to give up [-].
        loose: Residual ratio at intermediate load factors [-].
        keep: Part of det F that one step may leave of the smallest one [-].
        linear: Backend of the sparse solves, see `dpl.fem.linear.backend`.
        mixed: Let the strains at the quadrature points be unknowns of their own (Magisano,
            Leonetti, Garcea 2017), for laws that can: fewer iterations, far larger steps.
        reuse: Residual ratio below which the last factor, as preconditioner of conjugate gradients
            on the new tangent, stands for a new one [-]; 0: a factor for every tangent.
        turned: Let the factor of K(0), turned with the nodes, stand for those of tangents while
            conjugate gradients with it are short. Whether an answer is stable is then known only
            where they were not.
    """

    problem: Problem
    tol: float = 1e-8
    max_iter: int = 15
    budget: int = 400
    smallest_step: float = 2.0**-10
    loose: float = 1e-2
    keep: float = 0.2
    linear: str = "auto"
    mixed: bool = True
    reuse: float = 0.1
    turned: bool = False

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: An attribute is out of range, or the backend is not there.
        """
        check_steps(self, parts=("tol", "loose", "keep", "smallest_step"))
        chosen(self.linear)

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
        own = load.poisson.expand(len(load.force), -1)
        guesses = [None] * len(own) if guess is None else guess.split(1)
        yield from in_step(
            [
                self.at(nu[None])._member(force[None], start)
                for force, nu, start in zip(load.force, own, guesses, strict=True)
            ]
        )

    def but(self, **changes: Any) -> "Newton":
        """Return the solver with other attributes, those of its K(0) excepted: it keeps that."""
        other = replace(self, **changes)
        other.__dict__["rest"] = self.rest
        return other

    def at(self, poisson: Tensor | float) -> "Newton":
        """Return the solver of the body of another Poisson's ratio, see `Problem.at`.

        It has a K(0) of its own to factorise; those of the last few are kept.
        """
        problem = self.problem.at(poisson)
        return self if problem is self.problem else _kept(self._twins, problem, self._twin)

    def _twin(self, problem: Problem) -> "Newton":
        twin = replace(self, problem=problem)
        twin.__dict__["_backend"] = self._backend
        twin.__dict__["rest"] = _kept(self.rest._twins, problem, self.rest._twin)
        return twin

    @cached_property
    def _twins(self) -> "dict[Problem, Newton]":
        return {}

    def _member(self, force: Tensor, guess: Tensor | None) -> Iterator[Solution]:
        """Yield the states under one load (1, N, D)."""
        problem, count = self.problem, _Count()
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
            tol = self.tol if whole or step < CAREFUL else self.loose
            for iterate in self._correct(state, force, target, tol, count):
                state = iterate
                yield self._report(state, force, count)
            if self._balanced(state, force, target, tol):
                base, count.known, step = state, target, 2 * step
            else:  # a guess that failed costs no load step
                step = step if count.guessed else (target - count.known) / 2
                state, count.guessed = base, False
            lost = step < self.smallest_step
            spent = count.iterations >= self.budget
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
        count.near = None
        for _ in range(self.max_iter):
            ratio = self._ratio(state, force, target)
            if not ratio < self.reuse:
                count.near = None
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
            if self._balanced(state, force, target, tol) or count.iterations >= self.budget:
                return
            before = ratio

    def _forcing(self, ratio: float, before: float) -> float:
        """Return the relative residual that a linear solve may leave.

        As much as does not slow Newton down; `before` is the residual ratio an iteration ago, NaN
        in the first one.

        Source: Eisenstat, Walker (1996), SIAM J. Sci. Comput. 17, choice 2.
        """
        enough = 0.1 * self.tol / ratio if ratio > 0 else 0.0
        unknown = 1e-3 if self.turned else 0.0
        earned = 0.01 * (ratio / before) ** 2 if before > 0 else unknown
        return max(1e-12, enough, min(1e-3, earned))

    def _update(self, state: "_State", force: Tensor, count: "_Count", rtol: float) -> Tensor:
        """Return the full Newton step (1, N, D) under a force, supports included.

        Raises:
            SingularMatrix: The tangent has no factor.
        """
        problem, u = self.problem, state.displacement
        count.tangent = None
        if not u.any():
            right = self._right(state, force, state.internal)
            count.negative_pivots = _pivots(self.rest.factor)
            return scatter(self.rest.factor.solve(right, rtol), problem)[None] + state.jump
        system = problem.linearise(u, state.gap)
        if not system.valid:
            system = problem.linearise(u)
        right, values = self._right(state, force, system.force), system.tangent[0].numpy()
        step = None
        if count.near is None and count.turns and self.turned:
            count.near = self.rest.turning.at(u)
        if count.near is not None and count.near.negative_pivots <= 0:
            product = SymmetricProduct(problem.pattern, values)
            doubtful = isinstance(count.near, Turned)
            steps = TURNS if doubtful else PATIENCE
            with suppress(SingularMatrix):
                step = conjugate_gradients(
                    product, count.near.apply, right, rtol, steps, doubtful=doubtful
                )
                count.tangent = product
        if step is None:
            count.turns &= not isinstance(count.near, Turned)
            count.factorisations += 1
            count.near = None  # its storage serves the next one
            count.near = self._backend.factorise(values)
            step = count.near.solve(right, rtol)
            count.negative_pivots = count.near.negative_pivots
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
        floor = self.keep * min(float(state.volume_ratio), 1.0)
        for length in (0.5 ** np.arange(10 if shorten else 1)).tolist():
            jump = (1 - length) * state.jump
            end = self._state(state.displacement + length * update, jump)
            if end.volume_ratio > floor:
                if self.mixed and self.problem.mixes:
                    return end._replace(gap=self.problem.widened(state.gap, length, update))
                return end
        return None

    @cached_property
    def rest(self) -> Linear:
        """The linear answer, with the factor that every first step from zero uses."""
        return Linear(self.problem, self.tol, self.linear)

    @cached_property
    def _backend(self) -> Backend:
        return _backend_of(self.problem, self.linear)

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
            ratio = self.problem.imbalance(state.internal, target * force)
            state.ratios[target] = float(ratio)
        return state.ratios[target]

    def _balanced(self, state: "_State", force: Tensor, target: float, tol: float) -> bool:
        if not state.volume_ratio > 0 or state.jump.any():
            return False
        if (ratio := self._ratio(state, force, target)) < tol:
            return True
        u, internal = state.displacement, state.internal
        stuck = 0.1 * state.before < ratio < 1e-4
        return stuck and bool(self.problem.balanced(u, internal, target * force, tol))

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
            pivots = self._negative_pivots(state, count)
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
            factorisations=torch.tensor([count.factorisations]),
            load_factor=torch.tensor([factor], dtype=force.dtype),
            seconds=torch.tensor([time.perf_counter() - count.start], dtype=torch.float64),
            from_guess=torch.tensor([count.guessed]),
        )

    def _negative_pivots(self, state: "_State", count: "_Count") -> int:
        """Return those of the tangent at an answer; factorised only where there may be some.

        There may if the last tangent had some, or was not examined (conjugate gradients); or, where
        an older factor served for it, if it has an eigenvalue far below that factor's.
        """
        if isinstance(count.near, Turned):
            return -1
        suspect = count.negative_pivots > 0 or isinstance(count.near, CGFactor)
        if not suspect and count.tangent is not None and count.near is not None:
            size = self.problem.pattern.size
            with suppress(SingularMatrix):
                suspect |= lowest(count.tangent, count.near.apply, size) < DOUBT
            count.tangent = None
        if suspect:
            count.factorisations += 1
            count.near = None
            count.negative_pivots = self.negative_pivots(state.displacement)
        return count.negative_pivots

    def factorise(self, tangent: NDArray[np.float64]) -> Factor:
        """Return the factor of a tangent's entries (nnz,), see `Backend.factorise`."""
        return self._backend.factorise(tangent)

    def negative_pivots(self, displacement: Tensor) -> int:
        """Return the negative eigenvalues of the tangent at (1, N, D); 1 where it is singular.

        Conjugate gradients do not count them: 1 stands for some, -1 for not known.
        """
        tangent = self.problem.linearise(displacement).tangent
        try:
            return _pivots(self.factorise(tangent[0].numpy()))
        except SingularMatrix:  # at the critical load itself
            return 1


class _State(NamedTuple):
    """An iterate, evaluated once, and how far its supports have yet to move."""

    displacement: Tensor
    internal: Tensor
    volume_ratio: Tensor
    jump: Tensor
    gap: Any
    ratios: dict[float, float]
    before: float = 0.0  # residual ratio that the step came from


@dataclass
class _Count:
    """What one load has cost so far, and what is known of it."""

    iterations: int = 0
    factorisations: int = 0
    negative_pivots: int = -1
    known: float = 0.0
    guessed: bool = False  # whether the guess, if there was one, has not failed
    near: Factor | Turned | None = None  # of the last tangent that was factorised
    tangent: SymmetricProduct | None = None  # the last one, if an older factor served for it
    turns: bool = True  # whether K(0)'s factor, turned, has not failed yet
    start: float = field(default_factory=time.perf_counter)


Twin = TypeVar("Twin")


def _kept(twins: dict[Problem, Twin], problem: Problem, make: Callable[[Problem], Twin]) -> Twin:
    """Return what belongs to a problem, made if it is not there; the oldest leaves for it."""
    if problem not in twins:
        if len(twins) >= TWINS:
            twins.pop(next(iter(twins)))
        twins[problem] = make(problem)
    return twins[problem]


def check_steps(solver: Any, parts: Sequence[str]) -> None:
    """Check the numbers of a solver that steps: `parts`, and reuse, max_iter, budget.

    Raises:
        ValueError: One is out of range.
    """
    for name in parts:
        if not 0 < getattr(solver, name) < 1:
            raise ValueError(f"{name} = {getattr(solver, name)} must lie between 0 and 1")
    if not 0 <= solver.reuse < math.inf:
        raise ValueError(f"reuse = {solver.reuse} must be 0 or more")
    for name in ("max_iter", "budget"):
        if getattr(solver, name) < 1:
            raise ValueError(f"{name} = {getattr(solver, name)} must be 1 or more")


def _pivots(factor: Factor) -> int:
    """Return the negative eigenvalues of what was factorised, see `Newton.negative_pivots`."""
    return factor.examined if isinstance(factor, CGFactor) else factor.negative_pivots


def _backend_of(problem: Problem, name: str, *, lasting: bool = False) -> Backend:
    """Return the backend for a problem's tangents, or for one whose factor answers many loads."""
    motions = problem.rigid_motions()[0][problem.free].numpy()
    best = chosen(name, problem.pattern, motions, lasting=lasting)
    return backend(problem.pattern, best, motions)


def gather(field: Tensor, problem: Problem) -> NDArray[np.float64]:
    """Return the free components, (n,), of a nodal field (N, D)."""
    return field[problem.free].numpy()


def scatter(values: NDArray[np.float64], problem: Problem) -> Tensor:
    """Return the nodal field (N, D) with these free components (n,), zero where held."""
    field = torch.zeros(problem.shape, dtype=torch.float64)
    field[problem.free] = torch.from_numpy(values)
    return field

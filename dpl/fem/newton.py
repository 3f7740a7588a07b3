"""Newton-Raphson on the nodal equilibrium f_int(u) = f, and the linear answer it starts with."""

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.linear import Backend, Factor, SingularMatrix, backend, chosen
from dpl.fem.materials import volume_change
from dpl.fem.problem import Problem
from dpl.fem.solution import Load, Solution, in_step, judge


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
        values = self.problem.tangent(rest)[0].numpy()
        return backend(self.problem.pattern, self.linear).factorise(values)

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the linear answer."""
        answer = torch.stack([self.respond(force) for force in load.force])
        yield judge(self.problem, answer, load, self.tol, iterations=1)

    def respond(self, force: Tensor) -> Tensor:
        """Return K(0)^-1 f, (N, D) [-], for f (N, D) [-]; zero where held."""
        return scatter(self.factor.solve(gather(force, self.problem)), self.problem)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without the factor."""
        return {"problem": self.problem, "tol": self.tol, "linear": self.linear}


@dataclass(frozen=True, eq=False)
class Newton:
    """Newton-Raphson that never accepts an inverted element, with load steps where it must.

    Full steps on the whole load first; a step that would bring det F at a quadrature point below
    `keep` of its value is shortened until it does not. (No line search on the residual norm: on
    the way to large rotations it rises a hundredfold before it falls.) Where that does not
    converge, the load is applied in steps, each half the one that failed, twice the one that
    succeeded; intermediate states need only `loose`.

    Source: Wriggers (2008), Nonlinear Finite Element Methods, sections 5.1 and 5.3.

    Attributes:
        problem: The body.
        tol: Residual ratio ||R_free|| / ||f|| of an answer [-].
        max_iter: Iterations per load step before it is halved.
        smallest_step: Load step, as a part of the load, below which to give up [-].
        loose: Residual ratio at intermediate load factors [-].
        keep: Part of det F that one step may leave of the smallest one [-].
        linear: Backend of the sparse solves, see `dpl.fem.linear.backend`.
        mixed: Let the strains at the quadrature points be unknowns of their own (Magisano,
            Leonetti, Garcea 2017), for laws that can: fewer iterations, far larger steps.
    """

    problem: Problem
    tol: float = 1e-8
    max_iter: int = 15
    smallest_step: float = 2.0**-10
    loose: float = 1e-2
    keep: float = 0.2
    linear: str = "auto"
    mixed: bool = True

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: An attribute is out of range, or the backend is not there.
        """
        for name in ("tol", "loose", "keep", "smallest_step"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name} = {getattr(self, name)} must lie between 0 and 1")
        if self.max_iter < 1:
            raise ValueError(f"max_iter = {self.max_iter} must be 1 or more")
        chosen(self.linear)

    def iterate(self, load: Load, *, guess: Tensor | None = None) -> Iterator[Solution]:
        """Yield the state before the first update and after each one.

        Members of a batch are solved one by one, in step; one that has ended repeats its end. A
        member that ends without an answer ends with its last equilibrium under a part of the load.

        Args:
            load: What acts.
            guess: Where to start, (B, N, D) [-]; zero if left out, and where it is inverted.
        """
        yield from in_step(
            [
                self._member(force[None], None if guess is None else guess[k, None])
                for k, force in enumerate(load.force)
            ]
        )

    def _member(self, force: Tensor, guess: Tensor | None) -> Iterator[Solution]:
        """Yield the states under one load (1, N, D)."""
        problem, count = self.problem, _Count()
        state = base = self._state(torch.zeros_like(force), problem.prescribed[None])
        guessed = guess is not None and bool(force.any() or problem.moved_supports)
        if guess is not None and guessed:
            held = torch.where(problem.free, guess, problem.prescribed)
            start = self._state(held, torch.zeros_like(force))
            state, guessed = (start, True) if start.volume_ratio > 0 else (base, False)
        known, step = 0.0, 1.0
        yield self._report(state, force, count, known)
        while not self._balanced(state, force, self.tol):
            target = min(known + step, 1.0)
            tol = self.tol if target == 1.0 else self.loose
            for iterate in self._correct(state, target * force, tol, count):
                state = iterate
                yield self._report(state, force, count, known)
            if self._balanced(state, target * force, tol):
                base, known, step = state, target, 2 * step
            else:  # a guess that failed costs no load step
                step, guessed = (step, False) if guessed else ((target - known) / 2, False)
                state = base
            if step < self.smallest_step:
                yield self._report(base, force, count, known)
                return
            ahead = min(known + step, 1.0) - known
            state = state._replace(jump=ahead * problem.prescribed[None])

    def _correct(
        self, state: "_State", force: Tensor, tol: float, count: "_Count"
    ) -> Iterator["_State"]:
        """Yield iterates under a fixed load until they balance it or cannot go on."""
        for _ in range(self.max_iter):
            try:
                update = self._update(state, force, count)
            except SingularMatrix:
                return
            count.iterations += 1
            length = self._uninverted_length(state, update)
            if length == 0:
                return
            strain = self._moved_strain(state, length, update)
            end = state.displacement + length * update
            state = self._state(end, (1 - length) * state.jump, strain)
            yield state
            if self._balanced(state, force, tol):
                return

    def _update(self, state: "_State", force: Tensor, count: "_Count") -> Tensor:
        """Return the full Newton step (1, N, D) under a force, supports included.

        Raises:
            SingularMatrix: The tangent has no factor.
        """
        problem, u = self.problem, state.displacement
        internal, factor = state.internal, self.rest.factor
        if state.strain is not None:
            internal, values = problem.mixed_system(u, state.strain)
        elif u.any():
            values = problem.tangent(u)
        if u.any():
            count.factorisations += 1
            factor = self._backend.factorise(values[0].numpy())
        right = force - internal
        if problem.moved_supports:
            right = right - problem.tangent_product(u, state.jump)
        return scatter(factor.solve(gather(right[0], problem)), problem)[None] + state.jump

    def _moved_strain(self, state: "_State", length: float, update: Tensor) -> Tensor | None:
        """Return the strain that mixed points take with a step; None: plain Newton goes on."""
        if not (self.mixed and self.problem.material.has_response):
            return None
        u = state.displacement
        here = self.problem.strain(u)
        before = here if state.strain is None else state.strain
        strain = before + length * (here - before + self.problem.strain_change(u, update))
        return strain if volume_change(2 * strain).min() > -1 + 1e-3 else None

    def _uninverted_length(self, state: "_State", update: Tensor) -> float:
        """Return the longest of the steps 1, 1/2, 1/4, ... that inverts nothing; 0: none does."""
        floor = self.keep * min(float(state.volume_ratio), 1.0)
        for length in 0.5 ** np.arange(10):
            if self.problem.volume_ratio(state.displacement + length * update)[0] > floor:
                return float(length)
        return 0.0

    @cached_property
    def rest(self) -> Linear:
        """The linear answer, with the factor that every first step from zero uses."""
        return Linear(self.problem, self.tol, self.linear)

    @cached_property
    def _backend(self) -> Backend:
        return backend(self.problem.pattern, self.linear)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without factors."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def _state(self, displacement: Tensor, jump: Tensor, strain: Tensor | None = None) -> "_State":
        internal = self.problem.internal_force(displacement)
        volume_ratio = self.problem.volume_ratio(displacement)
        return _State(displacement, internal, volume_ratio, jump, strain)

    def _balanced(self, state: "_State", force: Tensor, tol: float) -> bool:
        ratio = self.problem.imbalance(state.internal, force)
        return bool(ratio < tol and state.volume_ratio > 0 and not state.jump.any())

    def _report(self, state: "_State", force: Tensor, count: "_Count", known: float) -> Solution:
        converged = torch.tensor([self._balanced(state, force, self.tol)])
        return Solution(
            displacement=state.displacement,
            residual=self.problem.imbalance(state.internal, force),
            volume_ratio=state.volume_ratio,
            converged=converged,
            iterations=torch.tensor([count.iterations]),
            factorisations=torch.tensor([count.factorisations]),
            load_factor=torch.where(converged, 1.0, torch.tensor([known], dtype=force.dtype)),
        )


class _State(NamedTuple):
    """An iterate, evaluated once, and how far its supports have yet to move."""

    displacement: Tensor
    internal: Tensor
    volume_ratio: Tensor
    jump: Tensor
    strain: Tensor | None


@dataclass
class _Count:
    """What one load has cost so far."""

    iterations: int = 0
    factorisations: int = 0


def gather(field: Tensor, problem: Problem) -> NDArray[np.float64]:
    """Return the free components, (n,), of a nodal field (N, D)."""
    return field[problem.free].numpy()


def scatter(values: NDArray[np.float64], problem: Problem) -> Tensor:
    """Return the nodal field (N, D) with these free components (n,), zero where held."""
    field = torch.zeros(problem.shape, dtype=torch.float64)
    field[problem.free] = torch.from_numpy(values)
    return field

"""Equilibrium from a good guess without a tangent: K(0)^-1, turned, on residuals, accelerated."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dpl.fem.linear.interface import Array
from dpl.fem.problem import Problem
from dpl.fem.solvers.corotational import CorotatedFactor
from dpl.fem.solvers.newton import Newton
from dpl.fem.solvers.solution import Load, Solution, evaluate_solution, run_lockstep

WINDOW = 5  # steps in which the residual has to halve


@dataclass(frozen=True, eq=False)
class AndersonSolver:
    """Fixed-point steps u + M R(u), M the inverse of K(0) in the guess's turned frame.

    Each costs a residual and a solve with a factor that is there. Among the mixtures of earlier
    iterates the one with the smallest residual is stepped from, which on a linear problem is
    GMRES. It ends unfinished where the residual does not halve in five steps, or an element would
    invert: then Newton is to take over.

    Source: Anderson (1965), J. ACM 12; as a multisecant quasi-Newton method: Fang, Saad (2009),
    Numer. Linear Algebra Appl. 16, equation 24.

    Attributes:
        newton: Whose body, tolerance and factor of K(0) it takes.
        memory: Earlier iterates that are mixed.
        max_iter: Steps at most.
    """

    newton: Newton
    memory: int = 12
    max_iter: int = 30

    @property
    def problem(self) -> Problem:
        """The body."""
        return self.newton.problem

    @property
    def tol(self) -> float:
        """Residual ratio below which an answer counts as converged [-]."""
        return self.newton.tol

    def iterate(self, load: Load, *, guess: Tensor) -> Iterator[Solution]:
        """Yield the guess and the state after each step; loads one by one, in step.

        Args:
            load: What acts.
            guess: Where to start, (B, N, D) [-].
        """
        pairs = zip(load.unbatch(), guess.split(1), strict=True)
        yield from run_lockstep([self._member(single, u) for single, u in pairs])

    def _member(self, load: Load, guess: Tensor) -> Iterator[Solution]:
        start = time.perf_counter()
        newton = self.newton.at(load.poisson)
        problem, count = newton.problem, 0
        u = torch.where(problem.free, guess, problem.prescribed)
        state, right = self._state(load, u, count, start)
        yield state
        if state.converged or not state.volume_ratio > 0:
            return
        turned = newton.linear_solver.corotational.at(u)
        ratios = [float(state.residual)]
        past = _Past(self.memory, len(right))
        while count < self.max_iter:
            step = past.step(right, turned)
            u, count, before = u + problem.extend(step)[None], count + 1, right
            state, right = self._state(load, u, count, start)
            yield state
            ratios.append(float(state.residual))
            lost = not state.volume_ratio > 0 or not ratios[-1] < 10 * ratios[0]
            slow = count >= WINDOW and not min(ratios[-WINDOW:]) < 0.5 * ratios[-WINDOW - 1]
            if state.converged or lost or slow:
                return
            past.add(step, right - before)

    def _state(self, load: Load, u: Tensor, count: int, start: float) -> tuple[Solution, Array]:
        """Return a displacement as a solution, with what is out of balance there, (n,)."""
        problem = self.problem.at(load.poisson)
        internal, _ = evaluation = problem.evaluate(u)
        state = evaluate_solution(
            problem, u, load, self.tol,
            iterations=count, seconds=time.perf_counter() - start, from_guess=True,
            evaluation=evaluation,
        )  # fmt: skip
        return state, problem.restrict((load.force - internal)[0])


class _Past:
    """The last steps, what they did to the residual, and the products of the latter."""

    def __init__(self, memory: int, size: int) -> None:
        """Make room for so many steps (n,)."""
        self.moves, self.changes = np.empty((memory, size)), np.empty((memory, size))
        self.gram = np.empty((memory, memory))
        self.count = 0

    def add(self, move: Array, change: Array) -> None:
        """Remember a step and what it did, in the place of the oldest if there is no other."""
        place = self.count % len(self.moves)
        self.moves[place], self.changes[place] = move, change
        self.count += 1
        kept = min(self.count, len(self.moves))
        self.gram[place, :kept] = self.gram[:kept, place] = self.changes[:kept] @ change

    def step(self, right: Array, turned: CorotatedFactor) -> Array:
        """Return the step (n,) from the mixture of iterates with the smallest residual.

        Args:
            right: The residual now, (n,).
            turned: M.
        """
        kept = min(self.count, len(self.moves))
        if not kept:
            return turned.apply(right)
        moves, changes = self.moves[:kept], self.changes[:kept]
        mix = np.linalg.lstsq(self.gram[:kept, :kept], changes @ right, rcond=1e-13)[0]
        return turned.apply(right - mix @ changes) - mix @ moves

"""Anderson acceleration of a fixed-point iteration with the corotated inverse of K(0)."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dpl.fem.linear.interface import Array
from dpl.fem.linear.krylov import scaled_norm
from dpl.fem.problem import Problem
from dpl.fem.solvers.corotational import CorotatedFactor
from dpl.fem.solvers.newton import Newton
from dpl.fem.solvers.solution import Load, Solution, Status, evaluate_solution, run_lockstep

WINDOW = 5  # iterations in which the residual has to halve


@dataclass(frozen=True, eq=False)
class AndersonSolver:
    """Anderson acceleration of u + M R(u), M the corotated inverse of K(0) at the guess.

    An iteration costs one residual and one solve with the stored factor of K(0). It starts from
    the linear combination of earlier iterates with the smallest residual, which is GMRES on a
    linear problem. The iteration stops without convergence if the residual does not halve in five
    iterations or an element inverts; continue with Newton then.

    Source: Anderson (1965), J. ACM 12; as a multisecant quasi-Newton method: Fang, Saad (2009),
    Numer. Linear Algebra Appl. 16, equation 24.

    Attributes:
        newton: Solver whose body, tolerance and factor of K(0) are used.
        memory: Number of earlier iterates that are combined.
        max_iter: Largest number of iterations.
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
        """Relative residual below which a solution counts as converged [-]."""
        return self.newton.tol

    def iterate(self, load: Load, *, guess: Tensor) -> Iterator[Solution]:
        """Yield the guess and the state after each iteration; loads in lockstep.

        Args:
            load: The load.
            guess: Displacement to start from, (B, N, D) [-].
        """
        pairs = zip(load.unbatch(), guess.split(1), strict=True)
        yield from run_lockstep([self._member(single, u) for single, u in pairs])

    def _member(self, load: Load, guess: Tensor) -> Iterator[Solution]:
        """Yield the states under one load."""
        start, newton = time.perf_counter(), self.newton.with_parameters(load.parameters)
        problem = newton.problem
        u = torch.where(problem.free, guess, problem.prescribed)
        evaluation = problem.evaluate(u)
        state = evaluate_solution(
            self.problem, u, load, self.tol,
            seconds=time.perf_counter() - start, from_guess=True, evaluation=evaluation,
        )  # fmt: skip
        yield state
        if state.converged or not state.volume_ratio > 0:
            return
        factor = newton.linear_solver.corotational.at(u)
        right = problem.restrict(load.force[0] - evaluation.internal[0])
        residuals = [float(state.residual)]
        size = scaled_norm(right) / residuals[0]  # of the loads
        history = _History(self.memory, len(right))
        for count in range(1, self.max_iter + 1):
            step = history.step(right, factor)
            u = u + problem.extend(step)[None]
            evaluation, before = problem.evaluate(u), right
            right = problem.restrict(load.force[0] - evaluation.internal[0])
            if problem.moved_supports:  # the reactions are loads too
                residual = float(problem.relative_residual_of(evaluation.internal, load.force))
            else:
                residual = scaled_norm(right) / size
            residuals.append(residual)
            is_valid = float(evaluation.volume_ratio) > 0
            balanced = is_valid and residual < self.tol
            status = Status.CONVERGED if balanced else Status.NOT_CONVERGED
            yield state._replace(
                displacement=u,
                residual=torch.tensor([residual], dtype=torch.float64),
                volume_ratio=evaluation.volume_ratio,
                status=torch.tensor([int(status)]),
                iterations=torch.tensor([count]),
                load_factor=torch.tensor([float(balanced)], dtype=torch.float64),
                seconds=torch.tensor([time.perf_counter() - start], dtype=torch.float64),
            )
            diverges = not is_valid or not residual < 10 * residuals[0]
            slow = count >= WINDOW and not min(residuals[-WINDOW:]) < 0.5 * residuals[-WINDOW - 1]
            if balanced or diverges or slow:
                return
            history.add(step, right - before)


class _History:
    """Last steps, the changes of the residual that they caused, and the changes' Gram matrix."""

    def __init__(self, memory: int, size: int) -> None:
        """Allocate `memory` steps (n,)."""
        self.steps, self.changes = np.empty((memory, size)), np.empty((memory, size))
        self.gram = np.empty((memory, memory))
        self.count = 0

    def add(self, step: Array, change: Array) -> None:
        """Store a step and its change of the residual, in place of the oldest if full."""
        row = self.count % len(self.steps)
        self.steps[row], self.changes[row] = step, change
        self.count += 1
        n = min(self.count, len(self.steps))
        self.gram[row, :n] = self.gram[:n, row] = self.changes[:n] @ change

    def step(self, right: Array, factor: CorotatedFactor) -> Array:
        """Return the step (n,) from the combination of iterates with the smallest residual.

        The residual at the last iterate is `right` (n,); the factor is that of M.
        """
        n = min(self.count, len(self.steps))
        if not n:
            return factor.apply(right)
        steps, changes = self.steps[:n], self.changes[:n]
        weights = np.linalg.lstsq(self.gram[:n, :n], changes @ right, rcond=1e-13)[0]
        return factor.apply(right - weights @ changes) - weights @ steps

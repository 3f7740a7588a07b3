"""Anderson acceleration of a fixed-point iteration with the corotated inverse of K(0)."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dpl.fem.problem import Evaluation
from dpl.fem.solvers.corotational import CorotatedFactor
from dpl.fem.solvers.newton import Newton
from dpl.fem.solvers.solution import Load, Solution, evaluate_solution, run_lockstep

NEAR = 0.1  # relative residual below which the rotations of the nodes are kept [-]


@dataclass(frozen=True, eq=False)
class AndersonSolver:
    """Anderson acceleration of u + M R(u), M the corotated inverse of K(0).

    An iteration costs one residual and one solve with the stored factor of K(0). It starts from
    the linear combination of earlier iterates whose residual does no work in the earlier steps:
    the one of least energy, as in conjugate gradients, on a linear problem. M rotates with the
    iterates until the residual is below `NEAR`. The iteration stops without convergence if the
    residual does not halve in `window` iterations or an element inverts; continue with Newton then.

    Source: Anderson (1965), J. ACM 12; as a multisecant quasi-Newton method of type I: Fang, Saad
    (2009), Numer. Linear Algebra Appl. 16, section 4.

    Attributes:
        newton: Solver whose body, tolerance and factor of K(0) are used.
        memory: Number of earlier iterates that are combined.
        max_iter: Largest number of iterations.
        window: Number of iterations in which the residual has to halve.
    """

    newton: Newton
    memory: int = 12
    max_iter: int = 30
    window: int = 5

    def iterate(
        self, load: Load, *, guess: Tensor, evaluation: Evaluation | None = None
    ) -> Iterator[Solution]:
        """Yield the guess and the state after each iteration; loads in lockstep.

        Args:
            load, guess: The load, and the displacement to start from, (B, N, D) [-].
            evaluation: Internal force and min det F at the guess of one load, if known. The guess
                must then have the displacement of the supports.
        """
        pairs = zip(load.unbatch(), guess.split(1), strict=True)
        yield from run_lockstep([self._member(single, u, evaluation) for single, u in pairs])

    def _member(
        self, load: Load, guess: Tensor, evaluation: Evaluation | None
    ) -> Iterator[Solution]:
        """Yield the states under one load."""
        start, newton = time.perf_counter(), self.newton.with_parameters(load.parameters)
        problem, window = newton.problem, self.window
        u = guess if evaluation else torch.where(problem.free, guess, problem.prescribed)
        factor: CorotatedFactor | None = None
        residuals: list[float] = []
        right = step = np.zeros(len(problem.discretisation.free_numbers))
        S, C = np.empty((2, self.memory, len(right)))  # steps, changes of the residual
        products = np.empty((self.memory, self.memory))  # S C^T
        for count in range(self.max_iter + 1):
            evaluation = evaluation or problem.evaluate(u)
            seconds = time.perf_counter() - start
            state = evaluate_solution(
                self.newton.problem, u, load, newton.tol,
                iterations=count, seconds=seconds, from_guess=True, evaluation=evaluation,
            )  # fmt: skip
            yield state
            residuals.append(float(state.residual))
            is_slow = count >= window and not min(residuals[-window:]) < residuals[-1 - window] / 2
            diverges = not state.volume_ratio > 0 or not residuals[-1] < 10 * residuals[0]
            if state.converged or diverges or is_slow:
                return
            before, right = right, problem.restrict(load.force[0] - evaluation.internal[0])
            if factor is None or residuals[-1] > NEAR:
                factor = newton.linear_solver.corotational.at(u)
            used = slice(min(count, self.memory))
            if count:
                k = (count - 1) % self.memory
                S[k], C[k] = step, right - before
                products[k, used], products[used, k] = C[used] @ S[k], S[used] @ C[k]
            weights = np.linalg.lstsq(products[used, used], S[used] @ right, rcond=1e-13)[0]
            step = factor.apply(right - weights @ C[used]) - weights @ S[used]
            u, evaluation = u + problem.extend(step)[None], None

"""The textbook Newton method, as a reference."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from dpl.fem import Load, Newton, Problem, SingularMatrix, Solution, evaluate_solution
from dpl.fem.solvers import run_lockstep


@dataclass(frozen=True, eq=False)
class PlainNewton:
    """Newton with full steps, without safeguards against inverted elements.

    The iterations end when the residual is below the tolerance, when the norm of the last step is
    below `step_tol`, or after `max_iter` of them. A step below `step_tol` does not make a state
    converged: the residual decides, as for every other solver.

    Source: Odot, Haferssas, Cotin (2022), DeepPhysics, algorithm 1, where `step_tol` is eta. The
    paper states no limit of iterations.

    Attributes:
        solver: Newton solver that provides problem, linear solver and tolerance.
        max_iter: Maximum number of iterations.
        step_tol: Norm of a step over L below which the iterations end [-]; 0: the step does not
            end them.
    """

    solver: Newton
    max_iter: int = 20
    step_tol: float = 0.0

    def __post_init__(self) -> None:
        if self.max_iter < 1:
            raise ValueError(f"max_iter = {self.max_iter} must be 1 or more")
        if not 0 <= self.step_tol < math.inf:
            raise ValueError(f"step_tol = {self.step_tol} must be 0 or more")

    def iterate(self, load: Load, *, guess: Tensor | None = None) -> Iterator[Solution]:
        """Yield the state of all loads at a guess (B, N, D) [-], or zero, and after each step.

        Each state has the prescribed displacements of the supports.
        """
        starts = torch.zeros_like(load.force) if guess is None else guess
        starts = torch.where(self.problem.free, starts, self.problem.prescribed)
        pairs = zip(load.unbatch(), starts, strict=True)
        return run_lockstep([self._member(one, u[None], guess is not None) for one, u in pairs])

    @property
    def problem(self) -> Problem:
        """The problem of the solver."""
        return self.solver.problem

    @property
    def tol(self) -> float:
        """Relative residual below which a state has converged [-]."""
        return self.solver.tol

    def _member(self, load: Load, u: Tensor, guessed: bool) -> Iterator[Solution]:
        problem = self.problem.with_parameters(load.parameters)
        start = time.perf_counter()
        backend = self.solver.linear_solver.tangent_backend
        step = math.inf
        for k in range(self.max_iter + 1):
            state = evaluate_solution(
                self.problem, u, load, self.tol, iterations=k, from_guess=guessed
            )
            yield state._replace(
                factorisations=torch.tensor([k]),
                seconds=torch.tensor([time.perf_counter() - start], dtype=torch.float64),
            )
            if state.converged or k == self.max_iter or step < self.step_tol:
                return
            system = problem.linearise(u)
            right = problem.restrict((load.force - system.force)[0])
            try:
                factor = backend.factorise(system.tangent[0].numpy())
                update = problem.extend(factor.solve(right, 1e-10))[None]
            except SingularMatrix:
                return
            u, step = u + update, float(update.norm())

"""The textbook Newton method, as a reference."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from dpl.fem import Load, Newton, Problem, SingularMatrix, Solution, evaluate_solution
from dpl.fem.solvers.solution import run_lockstep


@dataclass(frozen=True, eq=False)
class PlainNewton:
    """Newton with full steps, without safeguards against inverted elements.

    The iterations end when the residual is below the tolerance, or after `max_iter` of them.

    Source: Odot, Haferssas, Cotin (2022), DeepPhysics, algorithm 1, without its second criterion, a
    short step: the residual decides, as for every other solver. The paper states no limit of
    iterations.
    """

    solver: Newton  # Newton solver that provides problem, linear solver and tolerance
    max_iter: int = 20  # maximum number of iterations

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
        for k in range(self.max_iter + 1):
            state = evaluate_solution(
                self.problem, u, load, self.tol, iterations=k, from_guess=guessed
            )
            yield state._replace(
                factorisations=torch.tensor([k]),
                seconds=torch.tensor([time.perf_counter() - start], dtype=torch.float64),
            )
            if state.converged or k == self.max_iter:
                return
            system = problem.linearise(u)
            right = problem.restrict((load.force - system.force)[0])
            try:
                factor = backend.factorise(system.tangent[0].numpy())
                update = problem.extend(factor.solve(right, 1e-10))[None]
            except SingularMatrix:
                return
            u = u + update

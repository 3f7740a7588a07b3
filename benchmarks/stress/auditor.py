"""Check every state of every solve of a stress case against its own evaluation."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from dpl.fem import Load, Problem, SingularMatrix, Solution, Solver, Status, installed_backends
from dpl.fem.assembly.sparsity import Pattern
from dpl.fem.linear import Backend, make_backend

COUNTING_BACKEND = (
    "pardiso" if "pardiso" in installed_backends() else "superlu"
)  # both count negative pivots
CRITICAL_LOAD_TOL = 1e-4  # of a critical load [-]


class Auditor:
    """Evaluates every state of every solve again and records false statements.

    Internal forces and min det F at the returned displacement are computed by tensor operations,
    not by the compiled loops that solvers use. Where a solution reports a tangent without negative
    pivots, a direct factorisation counts them. `violations` are false statements, one line each.
    """

    def __init__(self) -> None:
        """Start without records."""
        self.violations: list[str] = []
        self.solves, self.states_checked, self.min_detF = 0, 0, math.inf
        self._backends: dict[Pattern, Backend] = {}

    def wrap(
        self, solver: Solver, problem: Problem, tol: float, intermediate_tol: float = 1e-2
    ) -> "AuditedSolver":
        """Return a solver whose states are checked; those with 0 iterations are starts.

        It reports convergence below the relative residual `tol`, or `intermediate_tol` under a part
        of the load.
        """
        return AuditedSolver(solver, problem, tol, intermediate_tol, self)

    def merge(self, other: "Auditor") -> None:
        """Add the records of another auditor."""
        self.violations += other.violations
        self.solves += other.solves
        self.states_checked += other.states_checked
        self.min_detF = min(self.min_detF, other.min_detF)

    def check_iterate(self, problem: Problem, state: Solution) -> None:
        """Check min det F of an iterate."""
        self.states_checked += 1
        started = state.iterations > 0
        volume = problem.volume_ratio(state.displacement)
        strained = float(problem.dN.abs().max()) * state.displacement.abs().amax(dim=(1, 2))
        rounding = 1e-12 * (1 + strained) ** problem.shape[1]
        columns = state.volume_ratio, volume, started, rounding
        for said, found, accepted, nothing in zip(*columns, strict=True):
            if accepted:
                self.min_detF = min(self.min_detF, float(found))
            if accepted and not (float(found) > 0 and float(said) > 0):
                self.violations.append(
                    f"an iterate was accepted with min det F = {float(found):.3g}"
                )
            elif not math.isclose(float(said), float(found), rel_tol=1e-6, abs_tol=nothing):
                same = not (float(said) > 0 or float(found) > 0)  # both of no use
                if not same and not (math.isnan(float(said)) and math.isnan(float(found))):
                    self.violations.append(
                        f"min det F is {float(found):.3g}, reported was {float(said):.3g}"
                    )

    def check_result(
        self, problem: Problem, load: Load, state: Solution, tol: float, intermediate_tol: float
    ) -> None:
        """Check the status, residual and stability that a solution reports."""
        self.solves += len(load.force)
        body = problem.with_parameters(load.parameters)
        u, factor = state.displacement, state.load_factor[:, None, None]
        internal, volume = body.internal_force(u), body.volume_ratio(u)
        good = body.is_equilibrium(u, internal, load.force, 1.01 * tol) & (volume > 0)
        part = body.is_equilibrium(u, internal, factor * load.force, 1.01 * intermediate_tol) & (
            volume > 0
        )
        for k, status in enumerate(state.status.tolist()):
            stable = bool(state.converged[k]) and int(state.negative_pivots[k]) == 0
            if stable and (pivots := self._negative_pivots(body, u[k : k + 1])):
                self.violations.append(
                    f"reported as stable; the tangent has {pivots} negative pivots"
                )
            said = f"{Status(status)}, residual {float(state.residual[k]):.1e}"
            held = torch.where(problem.free, 0.0, (u - problem.prescribed)[k]).abs().max()
            if bool(state.converged[k]) and not (good[k] and held < 1e-12):
                ratio = float(body.relative_residual_of(internal, load.force)[k])
                self.violations.append(
                    f"reported: {said}; residual is {ratio:.1e}, det F {volume[k]:.2g}"
                )
            ended = status == Status.NO_VALID_EQUILIBRIUM and state.iterations[k] > 0
            if ended and not (part[k] and 0 <= float(factor[k]) < 1):
                self.violations.append(
                    f"reported: {said}; load factor {float(factor[k]):.3g} is no equilibrium"
                )

    def solve(self, solver: Solver, problem: Problem, load: Load, *, tol: float = 1e-8) -> Solution:
        """Return the last state of a solver, all of its states checked."""
        *_, last = self.wrap(solver, problem, tol).iterate(load)
        return last

    def _negative_pivots(self, body: Problem, displacement: Tensor) -> int:
        """Return the negative eigenvalues of the tangent, by elimination.

        Eigenvalues above `-CRITICAL_LOAD_TOL` relative to K(0) do not count: `dpl.fem.Newton` may
        report an equilibrium that close to a critical load as stable.
        """
        pattern = body.pattern
        factoriser = self._backends.setdefault(pattern, make_backend(pattern, COUNTING_BACKEND))
        here, rest = (body.linearise(u).tangent[0] for u in (displacement, 0 * displacement))
        values = (here + CRITICAL_LOAD_TOL * rest).numpy()
        try:
            return factoriser.factorise(values).stability
        except SingularMatrix:
            return 0


@dataclass(frozen=True, eq=False)
class AuditedSolver:
    """A solver whose states an auditor checks; a hybrid can correct with it too."""

    solver: Solver
    problem: Problem
    tol: float
    intermediate_tol: float
    auditor: Auditor

    def iterate(self, load: Load, *, guess: Tensor | None = None) -> Iterator[Solution]:
        """Yield the states of the solver."""
        more = {} if guess is None else {"guess": guess}
        body = self.problem.with_parameters(load.parameters)
        for state in self.solver.iterate(load, **more):
            self.auditor.check_iterate(body, state)
            yield state
        self.auditor.check_result(self.problem, load, state, self.tol, self.intermediate_tol)

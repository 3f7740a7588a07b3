"""The watch that is kept over every solve of a stress case."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from dpl.fem import Load, Problem, SingularMatrix, Solution, Solver, Status, installed_backends
from dpl.fem.assembly import Pattern
from dpl.fem.linear import Backend, make_backend

EXACT = "pardiso" if "pardiso" in installed_backends() else "superlu"  # both count negative pivots
NEAR = 1e-4  # of a critical load [-]


class Auditor:
    """Sees every state of every solve, evaluates it again, and remembers what was not true.

    What is held against a state is computed by tensor operations, not by the compiled loops that
    solvers use: internal forces and min det F at the displacement that is returned. Where an answer
    says that its tangent has no negative pivots, elimination counts them.

    Attributes:
        lies: What was said and is not so, in words.
        solves, iterates: How many were seen.
        smallest: Smallest min det F that was accepted [-].
    """

    def __init__(self) -> None:
        """Begin with nothing seen."""
        self.lies: list[str] = []
        self.solves, self.iterates, self.smallest = 0, 0, math.inf
        self._backends: dict[Pattern, Backend] = {}

    def over(self, solver: Solver, problem: Problem, tol: float, loose: float = 1e-2) -> "Watched":
        """Return a solver that is watched.

        Args:
            solver: Any; states of 0 iterations are its starts, the others are accepted.
            problem: The body.
            tol: Residual ratio below which it says that it has converged [-].
            loose: The same under a part of the load, where it ends with that.
        """
        return Watched(solver, problem, tol, loose, self)

    def take(self, other: "Auditor") -> None:
        """Add what another watch has seen."""
        self.lies += other.lies
        self.solves += other.solves
        self.iterates += other.iterates
        self.smallest = min(self.smallest, other.smallest)

    def see(self, problem: Problem, state: Solution) -> None:
        """Hold a state on the way to what is promised of it."""
        self.iterates += 1
        started = state.iterations > 0
        volume = problem.volume_ratio(state.displacement)
        strained = float(problem.dN.abs().max()) * state.displacement.abs().amax(dim=(1, 2))
        rounding = 1e-12 * (1 + strained) ** problem.shape[1]
        columns = state.volume_ratio, volume, started, rounding
        for said, found, accepted, nothing in zip(*columns, strict=True):
            if accepted:
                self.smallest = min(self.smallest, float(found))
            if accepted and not (float(found) > 0 and float(said) > 0):
                self.lies.append(f"an iterate was accepted with min det F = {float(found):.3g}")
            elif not math.isclose(float(said), float(found), rel_tol=1e-6, abs_tol=nothing):
                same = not (float(said) > 0 or float(found) > 0)  # both of no use
                if not same and not (math.isnan(float(said)) and math.isnan(float(found))):
                    self.lies.append(f"min det F is {float(found):.3g}, said was {float(said):.3g}")

    def end(self, problem: Problem, load: Load, state: Solution, tol: float, loose: float) -> None:
        """Hold an answer to what it says of itself."""
        self.solves += len(load.force)
        body = problem.at(load.poisson)
        u, factor = state.displacement, state.load_factor[:, None, None]
        internal, volume = body.internal_force(u), body.volume_ratio(u)
        good = body.is_equilibrium(u, internal, load.force, 1.01 * tol) & (volume > 0)
        part = body.is_equilibrium(u, internal, factor * load.force, 1.01 * loose) & (volume > 0)
        for k, status in enumerate(state.status.tolist()):
            stable = bool(state.converged[k]) and int(state.negative_pivots[k]) == 0
            if stable and (pivots := self._negative_pivots(body, u[k : k + 1])):
                self.lies.append(f"said to be stable; the tangent has {pivots} negative pivots")
            said = f"{Status(status)}, residual {float(state.residual[k]):.1e}"
            held = torch.where(problem.free, 0.0, (u - problem.prescribed)[k]).abs().max()
            if bool(state.converged[k]) and not (good[k] and held < 1e-12):
                ratio = float(body.relative_residual_of(internal, load.force)[k])
                self.lies.append(f"said: {said}; residual is {ratio:.1e}, det F {volume[k]:.2g}")
            ended = status == Status.NO_VALID_EQUILIBRIUM and state.iterations[k] > 0
            if ended and not (part[k] and 0 <= float(factor[k]) < 1):
                self.lies.append(f"said: {said}; {float(factor[k]):.3g} of the load is no part")

    def solve(self, solver: Solver, problem: Problem, load: Load, *, tol: float = 1e-8) -> Solution:
        """Return the last state of a solver under watch."""
        *_, last = self.over(solver, problem, tol).iterate(load)
        return last

    def _negative_pivots(self, body: Problem, displacement: Tensor) -> int:
        """Return the negative eigenvalues of the tangent, by elimination.

        Those within `NEAR` of K(0) in their direction are let pass: a load as near to a critical
        one may be taken for stable, see `dpl.fem.Newton`.
        """
        pattern = body.pattern
        factoriser = self._backends.setdefault(pattern, make_backend(pattern, EXACT))
        here, rest = (body.linearise(u).tangent[0] for u in (displacement, 0 * displacement))
        values = (here + NEAR * rest).numpy()
        try:
            return factoriser.factorise(values).negative_pivots
        except SingularMatrix:
            return 0


@dataclass(frozen=True, eq=False)
class Watched:
    """A solver whose states are seen by a watch; also what a hybrid corrects with."""

    solver: Solver
    problem: Problem
    tol: float
    loose: float
    watch: Auditor

    def iterate(self, load: Load, *, guess: Tensor | None = None) -> Iterator[Solution]:
        """Yield the solver's states."""
        more = {} if guess is None else {"guess": guess}
        body = self.problem.at(load.poisson)
        for state in self.solver.iterate(load, **more):
            self.watch.see(body, state)
            yield state
        self.watch.end(self.problem, load, state, self.tol, self.loose)

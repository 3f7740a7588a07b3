"""Newton-Raphson on the nodal equilibrium f_int(u) = f, with load steps where needed.

A load factor scales forces, follower loads and prescribed displacements.
"""

import math
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dpl.fem.linear.backends import BackendFactory, select_backend
from dpl.fem.linear.interface import UNKNOWN, SingularMatrix
from dpl.fem.options import check_options, option
from dpl.fem.problem import Problem
from dpl.fem.solvers.factor_reuse import TangentSolver, forcing_term, stability_at
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.solution import Load, Solution, Status, check_force, check_tol, run_lockstep

FULL_TOL_STEP = 2.0**-4  # load step below which intermediate states are solved to `tol` [-]


@dataclass(frozen=True, eq=False)
class Newton:
    """Newton-Raphson with a guard against inverted elements and automatic load stepping.

    Full steps on the whole load come first. A step that would reduce det F at a quadrature point
    below `min_detF_ratio` of its value is halved until it does not. Where the iterations do not
    converge, the load is applied in steps, which are halved or doubled as they fail or succeed.

    An equilibrium whose tangent has negative pivots is no minimum of the energy; its status is
    UNSTABLE. The tangent at the solution is factorised only if the last tangent had negative pivots
    or may have had some: a solution within 1e-4 of a critical load may pass as stable.

    Source: Wriggers (2008), Nonlinear Finite Element Methods, sections 5.1 and 5.3.

    Attributes:
        problem: The body.
        tol: Relative residual ||R_free|| / ||f|| of a solution [-], see
            `Problem.relative_residual_of`; at least 1e-15, below 1. Where rounding does not allow
            it, a solution whose residual no longer falls counts as converged, with a warning.
        max_iter: Iterations per load step before the step is halved.
        max_total_iter: Iterations in all before a load is given up.
        min_load_step: Part of the load below which a load step is given up [-].
        intermediate_tol: Relative residual at intermediate load factors [-].
        min_detF_ratio: Smallest ratio of min det F after and before a step [-].
        linear: Backend of the sparse solves, see `dpl.fem.linear.make_backend`.
        mixed_integration: Treat the strains at the quadrature points as independent unknowns
            (Magisano, Leonetti, Garcea 2017), for laws that support it: fewer iterations. With mean
            dilatation the volume changes and pressures of the cells are unknowns as well.
        factor_reuse_tol: Relative residual below which the last factor preconditions conjugate
            gradients on the new tangent [-]; 0: every tangent is factorised.
        corotational: Precondition conjugate gradients with the factor of K(0), rotated with the
            nodes. Stability is then known only where a tangent was factorised.
        abandon_indefinite_guess: Start again from rest where the tangent at an iterate from the
            guess is indefinite. Such iterates seldom lead to a solution, and their tangents cost
            most.
        linear_solver: Solver with the factor of K(0); `dataclasses.replace` keeps it unless
            `problem` or `linear` change.
    """

    problem: Problem
    tol: float = 1e-8
    max_iter: int = option("", default=15, least=1)
    max_total_iter: int = option("", default=400, least=1)
    min_load_step: float = option("", default=2.0**-10, above=0, below=1)
    intermediate_tol: float = option("", default=1e-2, above=0, below=1)
    min_detF_ratio: float = option("", default=0.2, above=0, below=1)
    linear: str | BackendFactory = "auto"
    mixed_integration: bool = True
    factor_reuse_tol: float = option("", default=0.1, least=0)
    corotational: bool = False
    abandon_indefinite_guess: bool = False
    linear_solver: LinearSolver = field(default=None, repr=False)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        check_tol(self.tol)
        check_options(self)
        select_backend(self.linear)
        given = self.linear_solver
        if given is None or given.problem is not self.problem or given.linear != self.linear:
            made = LinearSolver(self.problem, self.tol, self.linear)
            object.__setattr__(self, "linear_solver", made)

    def iterate(self, load: Load, *, guess: Tensor | None = None) -> Iterator[Solution]:
        """Yield the state before the first update and after each one.

        The loads of a batch are solved in lockstep, see `run_lockstep`. One that does not converge
        ends with its last equilibrium under a part of the load.

        Args:
            load: The load; a force that does not fit the body is a ValueError.
            guess: Displacement to start from, (B, N, D) [-]; zero where it inverts an element.
        """
        check_force(self.problem, load)
        self.problem.material.require_known("Newton's method")
        members = load._replace(force=self.problem.acting(load.force)).unbatch()
        guesses = [None] * len(members) if guess is None else guess.split(1)
        solvers = (self.with_parameters(member.parameters) for member in members)
        each = zip(solvers, members, guesses, strict=True)
        yield from run_lockstep([newton._apply_load(f.force, u) for newton, f, u in each])

    def identity(self) -> dict[str, Any]:
        """Return class name and tolerance; the other options only change the iterations."""
        return {"name": type(self).__name__, "tol": float(self.tol)}

    def with_parameters(self, parameters: Tensor) -> "Newton":
        """Return the solver of the body with other parameters, see `Problem.with_parameters`."""
        linear = self.linear_solver.with_parameters(parameters)
        if linear is self.linear_solver:
            return self
        return replace(self, problem=linear.problem, linear_solver=linear)

    def stability(self, displacement: Tensor) -> int:
        """Return the negative eigenvalues of the tangent at (1, N, D), see `Factor.stability`."""
        return stability_at(self.problem, self.linear_solver.tangent_backend, displacement)

    def _apply_load(self, force: Tensor, guess: Tensor | None) -> Iterator[Solution]:
        """Yield the states under one load (1, N, D), applied in steps if necessary."""
        tangents = TangentSolver(self.linear_solver, corotational=self.corotational)
        run, zero = _Run(tangents, LoadStepping(self.min_load_step)), torch.zeros_like(force)
        one, supports = torch.ones(1, dtype=force.dtype), self.problem.prescribed[None]
        internal = self.problem.force_at_rest[None]
        state = base = _State(zero, internal, one, supports, {})  # at rest, needs no evaluation
        is_loaded = force.any() or self.problem.is_loaded_at_rest
        if guess is not None and guess.any() and is_loaded:
            u = torch.where(self.problem.free, guess, self.problem.prescribed)
            start = _State(u, *self.problem.evaluate(u), zero, {})
            if start.volume_ratio > 0:
                state, run.from_guess = start, True
        yield self._report(state, force, run)
        while not self._is_balanced(state, force, 1.0, self.tol):
            steps, target = run.steps, run.steps.target
            intermediate = target < 1 and steps.step >= FULL_TOL_STEP
            tol = self.intermediate_tol if intermediate else self.tol
            for iterate in self._newton_raphson(state, force, tol, run):
                state = iterate
                yield self._report(state, force, run)
            if self._is_balanced(state, force, target, tol):
                base = state
                steps.accept()
            elif run.from_guess:  # start again from rest, with the same load step
                state, run.from_guess = base, False
            else:
                state = base
                steps.reject()
            spent = run.iterations >= self.max_total_iter
            if steps.exhausted or (spent and not self._is_balanced(state, force, 1.0, self.tol)):
                lost = Status.NO_VALID_EQUILIBRIUM if steps.exhausted else Status.NOT_CONVERGED
                yield self._report(base, force, run, lost)
                return
            move = (steps.target - steps.factor) * self.problem.prescribed[None]
            state = state._replace(support_step=move)

    def _newton_raphson(
        self, state: "_State", force: Tensor, tol: float, run: "_Run"
    ) -> Iterator["_State"]:
        """Yield iterates under the target load until they balance it or an iteration fails."""
        factor, previous = run.steps.target, math.nan
        for k in range(self.max_iter):
            residual = self._residual(state, force, factor)
            rtol = forcing_term(residual, previous, tol=self.tol, corotational=self.corotational)
            near = k > 0 and residual < self.factor_reuse_tol
            try:
                update = self._solve(state, force, factor, run, rtol, near=near)
            except SingularMatrix:
                return
            run.iterations += 1
            found = self._update(state, update, halvings=0 if run.from_guess else 9)
            if found is None:
                return
            state, previous = found._replace(previous=residual), residual
            yield state
            spent = run.iterations >= self.max_total_iter
            if spent or self._is_balanced(state, force, factor, tol):
                return

    def _solve(
        self, state: "_State", force: Tensor, factor: float, run: "_Run", rtol: float, *, near: bool
    ) -> Tensor:
        """Return the full Newton step (1, N, D), also of supports, under part of a load."""
        problem, u = self.problem.under(factor), state.displacement
        internal, tangent, skew = self._internal(state, factor), None, None
        if u.any():
            system = problem.linearise(u, state.gap)
            system = system if system.valid else problem.linearise(u)
            internal, tangent = system.force, system.tangent[0].numpy()
            skew = None if system.skew is None else system.skew[0].numpy()
        right = factor * force - internal
        if state.support_step.any():
            right = right - problem.tangent_product(u, state.support_step)
        values = problem.restrict(right[0])
        definite = self.abandon_indefinite_guess and run.from_guess
        step = run.tangents.solve(tangent, u, values, rtol, near=near, definite=definite, skew=skew)
        return problem.extend(step)[None] + state.support_step

    def _update(self, state: "_State", update: Tensor, *, halvings: int) -> "_State | None":
        """Return the state after the longest of the steps 1, 1/2, ... that inverts no element."""
        bound = self.min_detF_ratio * min(float(state.volume_ratio), 1.0)
        for length in (0.5**k for k in range(halvings + 1)):
            u = state.displacement + length * update
            new = _State(u, *self.problem.evaluate(u), (1 - length) * state.support_step, {})
            if new.volume_ratio > bound:
                break
        else:
            return None
        if self.mixed_integration and self.problem.material.has_response:
            new = new._replace(gap=self.problem.update_strain_gap(state.gap, length, update, u))
        return new

    def _residual(self, state: "_State", force: Tensor, factor: float) -> float:
        """Return the relative residual under `factor` times a load, evaluated once."""
        if factor not in state.residuals:
            body = self.problem.under(factor)
            internal = self._internal(state, factor)
            state.residuals[factor] = float(body.relative_residual_of(internal, factor * force))
        return state.residuals[factor]

    def _internal(self, state: "_State", factor: float) -> Tensor:
        """Return f_int (1, N, D) at a state, with `factor` times the follower loads."""
        loads = self.problem.follower_loads
        if not loads or factor == 1:
            return state.internal
        return state.internal - (1 - factor) * loads.force(state.displacement)

    def _is_balanced(self, state: "_State", force: Tensor, factor: float, tol: float) -> bool:
        """Return True if a state balances `factor` times a load, to a tolerance or to rounding."""
        if not state.volume_ratio > 0 or state.support_step.any():
            return False
        if (residual := self._residual(state, force, factor)) < tol:
            return True
        if not 0.1 * state.previous < residual < 1e-4:  # the residual still falls
            return False
        body, internal = self.problem.under(factor), self._internal(state, factor)
        return bool(body.is_equilibrium(state.displacement, internal, factor * force, tol))

    def _report(
        self, state: "_State", force: Tensor, run: "_Run", end: Status | None = None
    ) -> Solution:
        """Return a state as a solution, with status `end` if given."""
        residual, pivots = self._residual(state, force, 1.0), UNKNOWN
        balanced = end is None and self._is_balanced(state, force, 1.0, self.tol)
        if balanced:
            if residual >= self.tol:
                warnings.warn(
                    f"||R||/||f|| = {residual:.1e} and not {self.tol:g}: rounding allows no less "
                    "on this body (very thin cells, moduli far apart?)",
                    stacklevel=2,
                )
            pivots = run.tangents.stability(state.displacement)
            end = Status.UNSTABLE if pivots > 0 else Status.CONVERGED
        factor = 1.0 if balanced else run.steps.factor
        return Solution(
            displacement=state.displacement,
            internal=state.internal,
            residual=torch.tensor([residual], dtype=force.dtype),
            volume_ratio=state.volume_ratio,
            status=torch.tensor([int(Status.NOT_CONVERGED if end is None else end)]),
            negative_pivots=torch.tensor([pivots]),
            iterations=torch.tensor([run.iterations]),
            factorisations=torch.tensor([run.tangents.factorisations]),
            load_factor=torch.tensor([factor], dtype=force.dtype),
            seconds=torch.tensor([time.perf_counter() - run.start], dtype=torch.float64),
            from_guess=torch.tensor([run.from_guess]),
        )


@dataclass
class LoadStepping:
    """Load factors of an incremental solution: a failed step is halved, the next one doubled."""

    min_step: float  # load step below which the solution is given up [-]
    factor: float = 0.0  # largest load factor for which an equilibrium is known [-]
    step: float = 1.0  # load step that is tried next [-]

    @property
    def target(self) -> float:
        """Load factor at the end of the next step [-], 1 for the whole load."""
        return min(self.factor + self.step, 1.0)

    @property
    def exhausted(self) -> bool:
        """True if the next step is below the smallest one allowed."""
        return self.step < self.min_step

    def accept(self) -> None:
        """Advance to the target and double the step."""
        self.factor, self.step = self.target, 2 * self.step

    def reject(self) -> None:
        """Halve the step."""
        self.step = (self.target - self.factor) / 2


class _State(NamedTuple):
    """An evaluated iterate."""

    displacement: Tensor  # u, (1, N, D) [-]
    internal: Tensor  # f_int(u) under the whole follower loads, (1, N, D) [-]
    volume_ratio: Tensor  # min det F, (1,) [-]
    support_step: Tensor  # displacement that the next step adds at the supports, (1, N, D) [-]
    residuals: dict[float, float]  # relative residuals by load factor
    gap: Any = None  # strain gap of the mixed integration points, see `update_strain_gap`
    previous: float = math.inf  # relative residual before that step [-]


@dataclass
class _Run:
    """Progress and cost of one load."""

    tangents: TangentSolver
    steps: LoadStepping
    iterations: int = 0
    from_guess: bool = False  # whether the iterates go on from the guess
    start: float = field(default_factory=time.perf_counter)

"""Hyper-reduced POD-Galerkin: Newton in the coordinates of a subspace on few weighted cells."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from benchmarks.reduced_problem import (
    ReducedLoad,
    ReducedProblem,
    ReducedState,
    beyond_linear,
    broyden,
    norm,
    refuse_range,
)
from dpl.fem.problem import Problem
from dpl.fem.rom.ecsw import Cubature, cubature, refuse_follower_loads
from dpl.fem.rom.pod import pod
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.load_stepping import LoadStepping, longest_valid_step
from dpl.fem.solvers.solution import Load, Solution, check_steps, evaluate_solution


class Reduced(NamedTuple):
    """Solution in reduced coordinates.

    Attributes:
        displacement: Displacement over L, (N, D) [-].
        residual: Reduced relative residual under the whole load [-].
        load_factor: Part of the load for which a reduced equilibrium was found [-].
        iterations, factorisations: Number of iterations, and of reduced tangents except at rest.
    """

    displacement: Tensor
    residual: float
    load_factor: float
    iterations: int
    factorisations: int


@dataclass(frozen=True, eq=False)
class PODGalerkin:
    """Galerkin projection of the equilibrium onto a subspace: u = offset + V c, V^T R(u) = 0.

    The offset is the displacement of the supports, or with `lift` the linear solution K(0)^-1 f,
    so that V only has to contain the nonlinear part.

    With a `cubature`, sums over all cells become sums over a few weighted ones, except for their
    linear part: V^T f_int(u) = V^T K(0) u + sum_e w_e V_e^T (f_e(u) - K_e(0) u_e). These forces
    derive from an energy, and are exact for small loads.

    Newton's method shortens steps and applies load steps as `Newton` does. An inverse tangent is
    reused with Broyden updates while the residual halves. The reduced relative residual is
    ||L^-1 V^T R|| / ||L^-1 V^T f|| with L L^T = V^T K(0) V: to first order the relative error in
    the energy norm within the subspace.

    The solution counts as converged if it balances the load on the whole body to `tol`, which a
    solution in a subspace seldom does.

    Source: Farhat, Avery, Chapman, Cortial (2014), Int. J. Numer. Methods Eng. 98 (ECSW).

    Attributes:
        problem: The body.
        vectors: V, orthonormal, zero at fixed degrees of freedom, (N, D, R) [-].
        cubature: Weighted cells; None: all cells.
        lift: Linear solver, if V is a basis of the displacement minus the linear solution.
        tol: Relative residual below which a solution counts as converged [-], see
            `Problem.relative_residual_of`; at least 1e-15, below 1.
        reduced_tol: Reduced relative residual at which the iterations stop [-].
        max_iter, max_total_iter, min_load_step, min_detF_ratio: As of `Newton`.
        factor_reuse_tol: Reduced relative residual below which an inverse tangent is reused [-].

    Raises:
        ValueError: V does not fit the body, an attribute is out of range, or, at the first load,
            the body has rigid body modes.
    """

    problem: Problem
    vectors: Tensor
    cubature: Cubature | None = None
    lift: LinearSolver | None = None
    tol: float = 1e-8
    reduced_tol: float = 1e-5
    max_iter: int = 30
    max_total_iter: int = 400
    min_load_step: float = 2.0**-10
    min_detF_ratio: float = 0.2
    factor_reuse_tol: float = 0.1

    @classmethod
    def fit(
        cls,
        problem: Problem,
        snapshots: Tensor,
        rank: int,
        *,
        tolerance: float | None = 1e-3,
        states: int = 256,
        lift: LinearSolver | None = None,
    ) -> Self:
        """Return the solver with basis and cells computed from equilibria.

        Args:
            problem, lift: Attributes of the solver.
            snapshots: Displacements in equilibrium, (S, N, D) [-].
            rank: Dimension R of the subspace.
            tolerance: Relative error of their reduced forces [-], see `cubature`; None: all cells.
            states: Number of evenly spaced snapshots from which the cells are chosen.

        Raises:
            ValueError: `rank` is out of range, see `pod`.
        """
        refuse_range(problem)
        refuse_follower_loads(problem, cls.__name__)
        basis = pod(beyond_linear(problem, snapshots, lift), rank).vectors
        vectors = torch.zeros(*problem.shape, rank, dtype=torch.float64)
        vectors[problem.free] = basis
        if tolerance is None:
            return cls(problem, vectors, None, lift)
        some = torch.linspace(0, len(snapshots) - 1, min(states, len(snapshots))).round().long()
        return cls.within(problem, vectors, snapshots[some], tolerance=tolerance, lift=lift)

    @classmethod
    def within(
        cls,
        problem: Problem,
        vectors: Tensor,
        states: Tensor,
        *,
        tolerance: float,
        lift: LinearSolver | None = None,
        **options: Any,
    ) -> Self:
        """Return the solver in a given subspace, with cells chosen at some states.

        Args:
            problem, vectors, lift, options: Attributes of the solver.
            states: Displacements in equilibrium, (S, N, D) [-]; they are projected onto V.
            tolerance: See `cubature`.
        """
        nonlinear, basis = beyond_linear(problem, states, lift), vectors[problem.free]
        projected = states.clone()
        projected[:, problem.free] -= nonlinear - (nonlinear @ basis) @ basis.T
        cells = cubature(problem, vectors, projected, tolerance)
        return cls(problem, vectors, cells, lift, **options)

    def __post_init__(self) -> None:
        """Check the ranges."""
        refuse_range(self.problem)
        refuse_follower_loads(self.problem, type(self).__name__)
        check_steps(self, parts=("reduced_tol", "min_detF_ratio", "min_load_step"))
        if tuple(self.vectors.shape[:2]) != self.problem.shape:
            found, wanted = tuple(self.vectors.shape), (*self.problem.shape, "R")
            raise ValueError(f"vectors.shape = {found} must be {wanted}")

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the solution; iterations and factorisations count reduced tangents.

        Raises:
            ValueError: Loads have parameters of their own.
        """
        if load.parameters.shape[-1]:
            raise ValueError("load.parameters must be empty; use dpl.fem.Newton")
        found, seconds = [], []
        for force in load.force:
            start = time.perf_counter()
            found.append(self.reduced(force))
            seconds.append(time.perf_counter() - start)
        answer = torch.stack([one.displacement for one in found])
        yield evaluate_solution(self.problem, answer, load, self.tol)._replace(
            iterations=torch.tensor([one.iterations for one in found]),
            factorisations=torch.tensor([one.factorisations for one in found]),
            seconds=torch.tensor(seconds, dtype=torch.float64),
        )

    def reduced(self, force: Tensor) -> Reduced:
        """Return the equilibrium in the subspace under a force (N, D) [-].

        Where none is found, it is that under the largest part of the load for which one was.
        """
        model, count = self.reduced_problem, _Count()
        load = model.reduce(force)
        state = model.state(load, torch.zeros_like(load.force), 0.0)
        steps = LoadStepping(self.min_load_step)
        if not load.has_offset and model.relative_residual(load, state, 1.0) < self.reduced_tol:
            steps.accept()
        while steps.factor < 1 and not steps.exhausted and count.iterations < self.max_total_iter:
            end = self._newton(load, state, steps.target, count)
            if end is None:
                steps.reject()
            else:
                state = end
                steps.accept()
        return Reduced(
            displacement=model.displacement(state.y).add_(load.offset, alpha=steps.factor),
            residual=model.relative_residual(load, state, 1.0),
            load_factor=steps.factor,
            iterations=count.iterations,
            factorisations=count.factorisations,
        )

    def _newton(
        self, load: ReducedLoad, state: ReducedState, target: float, count: "_Count"
    ) -> ReducedState | None:
        """Return the equilibrium under `target` times a load, None without convergence."""
        model = self.reduced_problem
        inverse, ratio, before = None, model.relative_residual(load, state, target), math.inf
        for _ in range(self.max_iter):
            jump = target - state.offset_factor if load.has_offset else 0.0
            if inverse is None or jump or not ratio < min(self.factor_reuse_tol, before / 2):
                count.factorisations += not state.at_rest
                inverse, right = model.tangent(load, state, target, jump)
                if inverse is None:
                    return None
            else:
                right = target * load.force - state.internal
            step = inverse @ right
            new = self._update(load, state, step, jump, target)
            count.iterations += 1
            if new is None:
                return None
            before, ratio = ratio, model.relative_residual(load, new, target)
            if new.offset_factor == target or not load.has_offset:
                short = 1e-2 * self.reduced_tol * target * load.scale
                if ratio < self.reduced_tol or (not jump and norm(step) < short):
                    return new
            if count.iterations >= self.max_total_iter:
                return None
            if ratio >= self.factor_reuse_tol:
                new = model.update_strain_gap(state, new)
            elif not jump:
                inverse = broyden(inverse, new.y - state.y, new.internal - state.internal)
            state = new
        return None

    def _update(
        self, load: ReducedLoad, state: ReducedState, step: Tensor, jump: float, target: float
    ) -> ReducedState | None:
        """Return the state after the longest of the steps 1, 1/2, ... that inverts no cell."""

        def state_after(length: float) -> ReducedState:
            part = target if jump and length == 1 else state.offset_factor + length * jump
            after = self.reduced_problem.state(load, state.y + length * step, part)
            return after._replace(length=length)

        return longest_valid_step(state_after, self.min_detF_ratio * min(state.volume_ratio, 1.0))

    @cached_property
    def reduced_problem(self) -> ReducedProblem:
        return ReducedProblem(self.problem, self.vectors, self.cubature, self.lift)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without cached properties."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


@dataclass
class _Count:
    """Cost of one load."""

    iterations: int = 0
    factorisations: int = 0

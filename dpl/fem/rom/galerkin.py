"""POD-Galerkin, hyper-reduced: Newton in a few coordinates on a few weighted cells, the classic
rival of neural surrogates.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from dpl.fem.problem import Problem
from dpl.fem.rom.ecsw import Cubature, cubature
from dpl.fem.rom.pod import pod
from dpl.fem.rom.reduced_problem import (
    ReducedLoad,
    ReducedProblem,
    ReducedState,
    beyond_linear,
    norm,
    refuse_range,
)
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.load_stepping import LoadStepping, longest_valid_step
from dpl.fem.solvers.solution import Load, Solution, check_steps, evaluate_solution


class Reduced(NamedTuple):
    """What Newton in reduced coordinates found.

    Attributes:
        displacement: (N, D) [-].
        coordinates: Of the displacement less prescribed and linear parts, in V, (R,) [-].
        residual: Reduced residual ratio under the whole load [-].
        load_factor: Part of the load that the coordinates balance [-].
        iterations: Steps that were taken.
        factorisations: Reduced tangents made, that of the rest state excepted.
    """

    displacement: Tensor
    coordinates: Tensor
    residual: float
    load_factor: float
    iterations: int
    factorisations: int


@dataclass(frozen=True, eq=False)
class PODGalerkin:
    """Galerkin's equilibrium in a subspace: u = offset + V c with V^T R(u) = 0.

    The offset is the displacement of the supports, or with `lift` the whole linear answer
    K(0)^-1 f, so that V has only to hold what is nonlinear.

    With a `cubature`, sums over all cells become sums over a few weighted ones, except for their
    linear part: V^T f_int(u) = V^T K(0) u + sum_e w_e V_e^T (f_e(u) - K_e(0) u_e). Forces so made
    still have an energy, and small loads are answered as by all cells.

    Newton's steps, with mixed integration points where the law can, are shortened where they would
    invert one of the cells, and fall back to load steps as in `Newton`. A tangent serves further
    steps, updated by Broyden's rank one, as long as they pay. Residuals are measured in the norm
    in which K(0) is the identity, ||L^-1 V^T R|| / ||L^-1 V^T f|| with L L^T = V^T K(0) V: to
    first order the relative error in the energy norm within the subspace.

    The answer is judged on the whole body: it is converged where it balances the load to `tol`
    there, which an answer in a subspace seldom does.

    Source: Farhat, Avery, Chapman, Cortial (2014), Int. J. Numer. Methods Eng. 98 (ECSW).

    Attributes:
        problem: The body.
        vectors: V, orthonormal, zero where held, (N, D, R) [-].
        cubature: The cells that stand for all; None: all of them.
        lift: The linear answer, if V is a basis of what is beyond it.
        tol: Residual ratio ||R_free|| / ||f|| below which an answer counts as converged [-], see
            `Problem.relative_residual_of`; at least 1e-15, below 1.
        reduced_tol: Reduced residual ratio that ends the iterations [-].
        max_iter: Steps per load step before it is halved.
        max_total_iter: Steps in all before a load is given up.
        min_load_step: Load step, as a part of the load, below which to give up [-].
        min_detF_ratio: Part of det F that one step may leave of the smallest one [-].
        factor_reuse_tol: Reduced residual ratio below which a tangent serves the next step too [-].

    Raises:
        ValueError: V is none of this body, an attribute is out of range, or, at the first load, the
            body is free to move.
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
        """Return the solver whose basis and cells are made from displacements in equilibrium.

        Args:
            problem: The body.
            snapshots: Displacements, each in balance with some load, (S, N, D) [-].
            rank: R.
            tolerance: Relative error of the snapshots' reduced forces that the choice of cells may
                make [-], see `cubature`; None: all cells.
            states: From so many of the snapshots, evenly spread, the cells are chosen.
            lift: The linear answer, to be added to what the subspace holds.

        Raises:
            ValueError: `rank` is not between 1 and the number of snapshots, or of free degrees of
                freedom.
        """
        refuse_range(problem)
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
        """Return the solver in a subspace that is there, with cells chosen at some states.

        Args:
            problem: The body.
            vectors: V, orthonormal, zero where held, (N, D, R) [-].
            states: Displacements in equilibrium, (S, N, D) [-]; the subspace's part of them counts.
            tolerance: See `cubature`.
            lift: The linear answer, to be added to what the subspace holds.
            options: Attributes of the solver.
        """
        rest, basis = beyond_linear(problem, states, lift), vectors[problem.free]
        held = states.clone()
        held[:, problem.free] -= rest - (rest @ basis) @ basis.T
        return cls(problem, vectors, cubature(problem, vectors, held, tolerance), lift, **options)

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: An attribute is out of range, or V is none of this body.
        """
        refuse_range(self.problem)
        check_steps(self, parts=("reduced_tol", "min_detF_ratio", "min_load_step"))
        if tuple(self.vectors.shape[:2]) != self.problem.shape:
            found, wanted = tuple(self.vectors.shape), (*self.problem.shape, "R")
            raise ValueError(f"vectors of shape {found} must have {wanted}")

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the answer; iterations and factorisations are those of reduced tangents.

        Raises:
            ValueError: Loads bring Poisson's ratios of their own.
        """
        if load.poisson.shape[-1]:
            raise ValueError("poisson: loads with their own need dpl.fem.Newton")
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

        Where none is found, that under the largest part of the load for which one was.
        """
        model, count = self._model, _Count()
        task = model.task(force)
        state = model.state(task, torch.zeros_like(task.load), 0.0)
        steps = LoadStepping(self.min_load_step)
        if not task.moves and model.ratio(task, state, 1.0) < self.reduced_tol:
            steps.accept()
        while steps.factor < 1 and not steps.exhausted and count.iterations < self.max_total_iter:
            end = self._corrected(task, state, steps.target, count)
            if end is None:
                steps.reject()
            else:
                state = end
                steps.accept()
        return Reduced(
            displacement=model.whole(state.y).add_(task.offset, alpha=steps.factor),
            coordinates=model.coordinates(state.y),
            residual=model.ratio(task, state, 1.0),
            load_factor=steps.factor,
            iterations=count.iterations,
            factorisations=count.factorisations,
        )

    def correct(self, force: Tensor, guess: Tensor, *, steps: int = 1) -> Tensor:
        """Return a displacement (N, D) nearer to balance with a force (N, D) than a guess (N, D).

        Each step evaluates all cells once and looks in the subspace for the displacement at which
        the chosen cells feel what is out of balance more than before: the coarse step of a full
        approximation scheme. So the choice of cells costs speed of convergence and not accuracy;
        what the subspace does not hold of the error stays. A step that is not found, or comes from
        where a cell is inverted, is not taken.

        Source: Brandt (1977), Math. Comput. 31, section 5.

        Args:
            force: [-].
            guess: [-].
            steps: At most; each takes an evaluation of all cells.
        """
        model, problem = self._model, self.problem
        scale, none = norm(model.load(force)) or 1.0, torch.zeros_like(model.pull)
        answer = guess
        for _ in range(steps):
            internal, volume = problem.evaluate(answer[None])
            if not volume > 0:
                break
            unbalanced = model.load(torch.where(problem.free, force - internal[0], 0.0))
            at_cells = answer[model.cells.nodes].flatten()
            task = ReducedLoad(none, scale, True, answer, at_cells, none, none)
            state = model.state(task, none, 1.0)
            task = task._replace(load=state.internal + unbalanced)
            end = self._corrected(task, state, 1.0, _Count())
            if end is None:
                break
            answer = answer + model.whole(end.y)
        return answer

    def _corrected(
        self, task: ReducedLoad, state: ReducedState, target: float, count: "_Count"
    ) -> ReducedState | None:
        """Return the equilibrium under `target` times a load, None where steps do not lead."""
        model = self._model
        inverse, ratio, before = None, model.ratio(task, state, target), math.inf
        for _ in range(self.max_iter):
            jump = target - state.part if task.moves else 0.0
            if inverse is None or jump or not ratio < min(self.factor_reuse_tol, before / 2):
                count.factorisations += not state.at_rest
                inverse, right = model.tangent(task, state, target, jump)
                if inverse is None:
                    return None
            else:
                right = target * task.load - state.internal
            step = inverse @ right
            new = self._stepped(task, state, step, jump, target)
            count.iterations += 1
            if new is None:
                return None
            before, ratio = ratio, model.ratio(task, new, target)
            if new.part == target or not task.moves:
                short = 1e-2 * self.reduced_tol * target * task.scale
                if ratio < self.reduced_tol or (not jump and norm(step) < short):
                    return new
            if count.iterations >= self.max_total_iter:
                return None
            if ratio >= self.factor_reuse_tol:
                new = model.update_strain_gap(state, new)
            elif not jump:
                inverse = _broyden(inverse, new.y - state.y, new.internal - state.internal)
            state = new
        return None

    def _stepped(
        self, task: ReducedLoad, state: ReducedState, step: Tensor, jump: float, target: float
    ) -> ReducedState | None:
        """Return the state after the longest of the steps 1, 1/2, 1/4, ... that inverts nothing."""

        def state_after(length: float) -> ReducedState:
            part = target if jump and length == 1 else state.part + length * jump
            return self._model.state(task, state.y + length * step, part)._replace(length=length)

        return longest_valid_step(state_after, self.min_detF_ratio * min(state.volume_ratio, 1.0))

    @cached_property
    def _model(self) -> ReducedProblem:
        return ReducedProblem(self.problem, self.vectors, self.cubature, self.lift)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without what is computed from the rest."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


@dataclass
class _Count:
    """What one load has cost so far."""

    iterations: int = 0
    factorisations: int = 0


def _broyden(inverse: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """Return an inverse that maps the change of the force to the step that made it.

    Source: Broyden (1965), Math. Comp. 19, the first method in Sherman's and Morrison's form.
    """
    moved = inverse @ change
    scale = step @ moved
    if not scale.abs() > 1e-8 * step.norm() * moved.norm():
        return inverse
    return inverse + torch.outer((step - moved) / scale, step @ inverse)

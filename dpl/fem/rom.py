"""POD-Galerkin, hyper-reduced: Newton in a few coordinates on a few weighted cells, the classic
rival of neural surrogates.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from dpl.fem.compliance import Linear
from dpl.fem.cubature import Cells, Cubature, cubature, whitening
from dpl.fem.dofs import gather, scatter
from dpl.fem.pod import pod
from dpl.fem.problem import Problem
from dpl.fem.solution import Load, Solution, check_steps, judge

LIFT = 1e-6  # residual ratio to which the linear answer is found where the subspace adds to it


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
        tol: Residual ratio ||R_free|| / ||f|| below which an answer counts as converged [-].
        reduced_tol: Reduced residual ratio that ends the iterations [-].
        max_iter: Steps per load step before it is halved.
        budget: Steps in all before a load is given up.
        smallest_step: Load step, as a part of the load, below which to give up [-].
        keep: Part of det F that one step may leave of the smallest one [-].
        reuse: Reduced residual ratio below which a tangent serves the next step too [-].

    Raises:
        ValueError: V is none of this body, an attribute is out of range, or, at the first load, the
            body is free to move.
    """

    problem: Problem
    vectors: Tensor
    cubature: Cubature | None = None
    lift: Linear | None = None
    tol: float = 1e-8
    reduced_tol: float = 1e-5
    max_iter: int = 30
    budget: int = 400
    smallest_step: float = 2.0**-10
    keep: float = 0.2
    reuse: float = 0.1

    @classmethod
    def fit(
        cls,
        problem: Problem,
        snapshots: Tensor,
        rank: int,
        *,
        tolerance: float | None = 1e-3,
        states: int = 256,
        lift: Linear | None = None,
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
        _refuse_range(problem)
        basis = pod(_beyond_linear(problem, snapshots, lift), rank).vectors
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
        lift: Linear | None = None,
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
        rest, basis = _beyond_linear(problem, states, lift), vectors[problem.free]
        held = states.clone()
        held[:, problem.free] -= rest - (rest @ basis) @ basis.T
        return cls(problem, vectors, cubature(problem, vectors, held, tolerance), lift, **options)

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: An attribute is out of range, or V is none of this body.
        """
        _refuse_range(self.problem)
        check_steps(self, parts=("tol", "reduced_tol", "keep", "smallest_step"))
        if tuple(self.vectors.shape[:2]) != self.problem.shape:
            found, wanted = tuple(self.vectors.shape), (*self.problem.shape, "R")
            raise ValueError(f"vectors of shape {found} must have {wanted}")

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the answer; iterations and factorisations are those of reduced tangents.

        Raises:
            ValueError: Loads bring Poisson's ratios of their own.
        """
        if load.poisson.shape[-1]:
            raise ValueError("poisson: loads with their own need dpl.fem.newton.Newton")
        found, seconds = [], []
        for force in load.force:
            start = time.perf_counter()
            found.append(self.reduced(force))
            seconds.append(time.perf_counter() - start)
        answer = torch.stack([one.displacement for one in found])
        yield judge(self.problem, answer, load, self.tol)._replace(
            iterations=torch.tensor([one.iterations for one in found]),
            factorisations=torch.tensor([one.factorisations for one in found]),
            seconds=torch.tensor(seconds, dtype=torch.float64),
        )

    def reduced(self, force: Tensor) -> Reduced:
        """Return the equilibrium in the subspace under a force (N, D) [-].

        Where none is found, that under the largest part of the load for which one was.
        """
        task, count = self._task(force), _Count()
        state = self._state(task, torch.zeros_like(task.load), 0.0)
        known, step = 0.0, 1.0
        if not task.moves and self._ratio(task, state, 1.0) < self.reduced_tol:
            known = 1.0
        while known < 1 and step >= self.smallest_step and count.iterations < self.budget:
            target = min(known + step, 1.0)
            end = self._corrected(task, state, target, count)
            if end is None:
                step = (target - known) / 2
            else:
                state, known, step = end, target, 2 * step
        return Reduced(
            displacement=self._model.whole(state.y).add_(task.offset, alpha=known),
            coordinates=self._model.coordinates(state.y),
            residual=self._ratio(task, state, 1.0),
            load_factor=known,
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
        scale, none = _norm(model.load(force)) or 1.0, torch.zeros_like(model.pull)
        answer = guess
        for _ in range(steps):
            internal, volume = problem.evaluate(answer[None])
            if not volume > 0:
                break
            unbalanced = model.load(torch.where(problem.free, force - internal[0], 0.0))
            at_cells = answer[model.cells.nodes].flatten()
            task = _Task(none, scale, True, answer, at_cells, none, none)
            state = self._state(task, none, 1.0)
            task = task._replace(load=state.internal + unbalanced)
            end = self._corrected(task, state, 1.0, _Count())
            if end is None:
                break
            answer = answer + model.whole(end.y)
        return answer

    def _corrected(
        self, task: "_Task", state: "_State", target: float, count: "_Count"
    ) -> "_State | None":
        """Return the equilibrium under `target` times a load, None where steps do not lead."""
        inverse, ratio, before = None, self._ratio(task, state, target), math.inf
        for _ in range(self.max_iter):
            jump = target - state.part if task.moves else 0.0
            if inverse is None or jump or not ratio < min(self.reuse, before / 2):
                inverse, right = self._tangent(task, state, target, jump, count)
                if inverse is None:
                    return None
            else:
                right = target * task.load - state.internal
            step = inverse @ right
            new = self._stepped(task, state, step, jump, target)
            count.iterations += 1
            if new is None:
                return None
            before, ratio = ratio, self._ratio(task, new, target)
            if new.part == target or not task.moves:
                short = 1e-2 * self.reduced_tol * target * task.scale
                if ratio < self.reduced_tol or (not jump and _norm(step) < short):
                    return new
            if count.iterations >= self.budget:
                return None
            if ratio >= self.reuse:
                new = self._widened(state, new)
            elif not jump:
                inverse = _broyden(inverse, new.y - state.y, new.internal - state.internal)
            state = new
        return None

    def _tangent(
        self, task: "_Task", state: "_State", target: float, jump: float, count: "_Count"
    ) -> tuple[Tensor | None, Tensor]:
        """Return the tangent's inverse, None if it has none, and what a step has to balance."""
        model, cells = self._model, self._model.cells
        if state.part == 0 and not state.y.any():
            return torch.eye(len(state.y), dtype=torch.float64), target * (task.load - task.pull)
        system = cells.problem.linearise(state.field, state.gap)
        if not system.valid:
            system = cells.problem.linearise(state.field)
        upper = cells.tangents(system.tangent[0])
        right = target * task.load - model.internal(cells.project(system.force), state.y)
        if task.moves:
            right -= state.part * task.rest
        if jump:
            right -= jump * (cells.project(cells.product(upper, task.at_cells)) + task.rest)
        count.factorisations += 1
        inverse, failed = torch.linalg.inv_ex(cells.reduced(upper) + model.rest)
        return (None if failed else inverse), right

    def _stepped(
        self, task: "_Task", state: "_State", step: Tensor, jump: float, target: float
    ) -> "_State | None":
        """Return the state after the longest of the steps 1, 1/2, 1/4, ... that inverts nothing."""
        floor = self.keep * min(state.volume, 1.0)
        for length in (0.5 ** np.arange(10)).tolist():
            part = target if jump and length == 1 else state.part + length * jump
            end = self._state(task, state.y + length * step, part)
            if end.volume > floor:
                return end._replace(length=length)
        return None

    def _widened(self, state: "_State", new: "_State") -> "_State":
        """Return the state after a step with the gap that its mixed points have."""
        problem = self._model.cells.problem
        if not problem.mixes:
            return new
        update = (new.field - state.field) / new.length
        return new._replace(gap=problem.widened(state.gap, new.length, update))

    def _state(self, task: "_Task", y: Tensor, part: float) -> "_State":
        """Return coordinates with what is known of them; `part` of the offset is there."""
        model, cells = self._model, self._model.cells
        values = cells.basis @ y
        if task.moves:
            values += part * task.at_cells
        field = cells.field(values)
        force, volume = cells.problem.evaluate(field)
        internal = model.internal(cells.project(force), y)
        if task.moves:
            internal += part * task.rest
        return _State(y, part, field, internal, float(volume))

    def _ratio(self, task: "_Task", state: "_State", target: float) -> float:
        """Return the reduced residual ratio under `target` times a load."""
        return _norm(target * task.load - state.internal) / (target * task.scale)

    def _task(self, force: Tensor) -> "_Task":
        """Return what a load (N, D) is in reduced coordinates."""
        model, problem = self._model, self.problem
        load, pull = model.load(force), model.pull
        scale = _norm(load - pull)
        offset, moves = problem.prescribed, self.lift is not None or problem.moved_supports
        if self.lift is not None:
            offset = offset + _linear_answer(self.lift, force - model.supports)
            pull = load
        at_cells = offset[model.cells.nodes].flatten() if moves else offset
        rest = pull - at_cells @ model.stiffness if moves else pull
        return _Task(load, scale if scale > 0 else 1.0, moves, offset, at_cells, pull, rest)

    @cached_property
    def _model(self) -> "_Model":
        return _Model(self.problem, self.vectors, self.cubature)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without what is computed from the rest."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


class _Task(NamedTuple):
    """A load in reduced coordinates.

    Attributes:
        load: V^T f, (R,).
        scale: Norm of what the first step has to balance, without lift.
        moves: Whether there is an offset.
        offset: Where u starts from at full load, (N, D).
        at_cells: The same at the cells' nodes, (C A D,).
        pull: V^T K(0) offset, (R,).
        rest: What of it the cells do not say, (R,).
    """

    load: Tensor
    scale: float
    moves: bool
    offset: Tensor
    at_cells: Tensor
    pull: Tensor
    rest: Tensor


class _State(NamedTuple):
    """An iterate, evaluated once, and the part of the offset that is in it."""

    y: Tensor
    part: float
    field: Tensor
    internal: Tensor
    volume: float
    length: float = 1.0  # of the step that led here
    gap: Any = None


@dataclass
class _Count:
    """What one load has cost so far."""

    iterations: int = 0
    factorisations: int = 0


class _Model:
    """What all loads share.

    Attributes:
        cells: The cells, with the basis W = V L^-T in which K(0) is the identity.
        stiffness: K(0) W of these cells alone, (C A D, R).
        rest: I less W^T K(0) W of these cells, (R, R).
        supports: K(0) prescribed, (N, D); zero where supports do not move.
        pull: The same in W, (R,).
    """

    def __init__(self, problem: Problem, vectors: Tensor, chosen: Cubature | None) -> None:
        """Take the body, V (N, D, R), and the cells that stand for all."""
        self.problem = problem
        self._white = whitening(problem, vectors)
        white = vectors @ self._white
        every = torch.arange(len(problem.cells))
        cells, weights = (every, torch.ones(len(every))) if chosen is None else chosen[:2]
        self.cells = Cells(problem, white, cells, weights.double())
        self.stiffness = self.cells.product(self.cells.at_rest(), self.cells.basis)
        rank = vectors.shape[2]
        self.rest = torch.eye(rank, dtype=torch.float64) - self.cells.basis.T @ self.stiffness
        self._white_rows = white.flatten(0, 1)
        self.supports = _support_force(problem)
        self.pull = self.load(self.supports)

    def load(self, force: Tensor) -> Tensor:
        """Return W^T f, (R,), of f (N, D)."""
        return force.flatten() @ self._white_rows

    def internal(self, force: Tensor, y: Tensor) -> Tensor:
        """Return the internal force of all cells, (R,), from that of the chosen ones."""
        return force + self.rest @ y

    def whole(self, y: Tensor) -> Tensor:
        """Return the displacement (N, D) of coordinates in W."""
        return (self._white_rows @ y).view(self.problem.shape)

    def coordinates(self, y: Tensor) -> Tensor:
        """Return coordinates in V, (R,), of those in W."""
        return self._white @ y


def _broyden(inverse: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """Return an inverse that maps the change of the force to the step that made it.

    Source: Broyden (1965), Math. Comp. 19, the first method in Sherman's and Morrison's form.
    """
    moved = inverse @ change
    scale = step @ moved
    if not scale.abs() > 1e-8 * step.norm() * moved.norm():
        return inverse
    return inverse + torch.outer((step - moved) / scale, step @ inverse)


def _norm(vector: Tensor) -> float:
    return float(torch.linalg.vector_norm(vector))


def _refuse_range(problem: Problem) -> None:
    """Raise where the law has a range of Poisson's ratios: what is reduced here has one."""
    if (span := problem.material.poisson_range) is not None:
        raise ValueError(
            f"poisson: reduced stiffness and cells are those of one, not of a range, {list(span)}; "
            "take Problem.at or dpl.fem.newton.Newton"
        )


def _beyond_linear(problem: Problem, snapshots: Tensor, lift: Linear | None) -> Tensor:
    """Return what moves of displacements in equilibrium, less their linear answers, (S, n)."""
    rest = snapshots[:, problem.free].double()
    if lift is not None:
        supports = _support_force(problem)
        for row, u in zip(rest, snapshots, strict=True):
            force = problem.evaluate(u[None]).internal[0] - supports
            row -= _linear_answer(lift, force)[problem.free]
    return rest


def _support_force(problem: Problem) -> Tensor:
    """Return K(0) prescribed, (N, D)."""
    if not problem.moved_supports:
        return torch.zeros(problem.shape, dtype=torch.float64)
    rest = torch.zeros(1, *problem.shape, dtype=torch.float64)
    return problem.tangent_product(rest, problem.prescribed[None])[0]


def _linear_answer(lift: Linear, force: Tensor) -> Tensor:
    """Return K(0)^-1 f, (N, D); what it is short of, the subspace adds."""
    problem = lift.problem
    return scatter(lift.factor.solve(gather(force, problem), LIFT), problem)

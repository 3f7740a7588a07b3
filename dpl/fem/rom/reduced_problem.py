"""A body in a subspace: its forces and tangents in few coordinates, from few weighted cells."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dpl.fem.problem import Problem
from dpl.fem.rom.ecsw import Cubature, ReducedMesh, whitening
from dpl.fem.solvers.linear import LinearSolver

LIFT = 1e-6  # residual ratio to which the linear answer is found where the subspace adds to it


class ReducedLoad(NamedTuple):
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


class ReducedState(NamedTuple):
    """An iterate, evaluated once, and the part of the offset that is in it."""

    y: Tensor
    part: float
    field: Tensor
    internal: Tensor
    volume_ratio: float
    length: float = 1.0  # of the step that led here
    gap: Any = None

    @property
    def at_rest(self) -> bool:
        """Whether nothing has moved: the tangent is the identity."""
        return self.part == 0 and not self.y.any()


class ReducedProblem:
    """A body seen from a subspace V by a few of its cells: what all loads share.

    Attributes:
        problem: The body.
        lift: The linear answer, if V is a basis of what is beyond it.
        cells: The cells, with the basis W = V L^-T in which K(0) is the identity.
        stiffness: K(0) W of these cells alone, (C A D, R).
        rest: I less W^T K(0) W of these cells, (R, R).
        supports: K(0) prescribed, (N, D); zero where supports do not move.
        pull: The same in W, (R,).
    """

    def __init__(
        self, problem: Problem, vectors: Tensor, chosen: Cubature | None, lift: LinearSolver | None
    ) -> None:
        """Take the body, V (N, D, R), the cells that stand for all, and the linear answer."""
        self.problem, self.lift = problem, lift
        self._white = whitening(problem, vectors)
        white = vectors @ self._white
        every = torch.arange(len(problem.cells))
        cells, weights = (every, torch.ones(len(every))) if chosen is None else chosen[:2]
        self.cells = ReducedMesh(problem, white, cells, weights.double())
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

    def task(self, force: Tensor) -> ReducedLoad:
        """Return what a load (N, D) is in reduced coordinates."""
        problem = self.problem
        load, pull = self.load(force), self.pull
        scale = norm(load - pull)
        offset, moves = problem.prescribed, self.lift is not None or problem.moved_supports
        if self.lift is not None:
            offset = offset + _linear_answer(self.lift, force - self.supports)
            pull = load
        at_cells = offset[self.cells.nodes].flatten() if moves else offset
        rest = pull - at_cells @ self.stiffness if moves else pull
        return ReducedLoad(load, scale if scale > 0 else 1.0, moves, offset, at_cells, pull, rest)

    def state(self, task: ReducedLoad, y: Tensor, part: float) -> ReducedState:
        """Return coordinates with what is known of them; `part` of the offset is there."""
        cells = self.cells
        values = cells.basis @ y
        if task.moves:
            values += part * task.at_cells
        field = cells.field(values)
        force, volume = cells.problem.evaluate(field)
        internal = self.internal(cells.project(force), y)
        if task.moves:
            internal += part * task.rest
        return ReducedState(y, part, field, internal, float(volume))

    def ratio(self, task: ReducedLoad, state: ReducedState, target: float) -> float:
        """Return the reduced residual ratio under `target` times a load."""
        return norm(target * task.load - state.internal) / (target * task.scale)

    def tangent(
        self, task: ReducedLoad, state: ReducedState, target: float, jump: float
    ) -> tuple[Tensor | None, Tensor]:
        """Return the tangent's inverse, None if it has none, and what a step has to balance."""
        cells = self.cells
        if state.at_rest:
            return torch.eye(len(state.y), dtype=torch.float64), target * (task.load - task.pull)
        system = cells.problem.linearise(state.field, state.gap)
        if not system.valid:
            system = cells.problem.linearise(state.field)
        upper = cells.tangents(system.tangent[0])
        right = target * task.load - self.internal(cells.project(system.force), state.y)
        if task.moves:
            right -= state.part * task.rest
        if jump:
            right -= jump * (cells.project(cells.product(upper, task.at_cells)) + task.rest)
        inverse, failed = torch.linalg.inv_ex(cells.reduced(upper) + self.rest)
        return (None if failed else inverse), right

    def update_strain_gap(self, state: ReducedState, new: ReducedState) -> ReducedState:
        """Return the state after a step with the gap that its mixed points have."""
        problem = self.cells.problem
        if not problem.supports_mip:
            return new
        update = (new.field - state.field) / new.length
        return new._replace(gap=problem.update_strain_gap(state.gap, new.length, update))


def norm(vector: Tensor) -> float:
    """Return the Euclidean norm of a vector (R,); no square of an entry over- or underflows."""
    largest = float(vector.abs().amax())
    if not 0 < largest < math.inf:
        return largest
    return largest * float(torch.linalg.vector_norm(vector / largest))


def refuse_range(problem: Problem) -> None:
    """Raise where the law has a range of Poisson's ratios: what is reduced here has one."""
    if (span := problem.material.poisson_range) is not None:
        raise ValueError(
            f"poisson: reduced stiffness and cells are those of one, not of a range, {list(span)}; "
            "take Problem.at or dpl.fem.Newton"
        )


def beyond_linear(problem: Problem, snapshots: Tensor, lift: LinearSolver | None) -> Tensor:
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


def _linear_answer(lift: LinearSolver, force: Tensor) -> Tensor:
    """Return K(0)^-1 f, (N, D); what it is short of, the subspace adds."""
    problem = lift.problem
    return problem.extend(lift.factor.solve(problem.restrict(force), LIFT))

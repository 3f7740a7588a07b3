"""Reduced problem: forces and tangents of a body in a subspace, from weighted cells."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dpl.fem.problem import Problem
from dpl.fem.rom.ecsw import Cubature, ReducedMesh, whitening
from dpl.fem.solvers.linear import LinearSolver

LIFT_TOL = 1e-6  # relative residual of the linear solution to which the subspace adds [-]


class ReducedLoad(NamedTuple):
    """A load in reduced coordinates.

    Attributes:
        force: W^T f, (R,).
        scale: Norm of the residual of the first step, without lift.
        has_offset: Whether the offset is not zero.
        offset: Displacement to which the subspace adds at full load, (N, D).
        cell_offset: Offset at the cells' nodes, (C A D,).
        offset_force: W^T K(0) offset, (R,).
        offset_error: Difference of `offset_force` and its sum over the cells, (R,).
    """

    force: Tensor
    scale: float
    has_offset: bool
    offset: Tensor
    cell_offset: Tensor
    offset_force: Tensor
    offset_error: Tensor


class ReducedState(NamedTuple):
    """An evaluated iterate.

    Attributes:
        y: Coordinates in W, (R,).
        offset_factor: Part of the offset that is applied [-].
        cell_displacement: Displacement of the cells, (1, C A, D).
        internal: Reduced internal force, (R,).
        volume_ratio: min det F of the cells [-].
        length: Length of the step that led here, 1 for a full one.
        gap: Strain gap of the mixed integration points, see `Problem.update_strain_gap`.
    """

    y: Tensor
    offset_factor: float
    cell_displacement: Tensor
    internal: Tensor
    volume_ratio: float
    length: float = 1.0
    gap: Any = None

    @property
    def at_rest(self) -> bool:
        """Whether the displacement is zero, where the tangent is the identity."""
        return self.offset_factor == 0 and not self.y.any()


class ReducedProblem:
    """A body in a subspace V, integrated over a few weighted cells.

    Attributes:
        problem: The body.
        lift: Linear solver, if V is a basis of the displacement minus the linear solution.
        cells: The cells, with the basis W = V L^-T in which K(0) is the identity.
        stiffness: K(0) W of the cells, (C A D, R).
        stiffness_error: I - W^T K(0) W of the cells, (R, R).
        reduced_support_force: W^T `Problem.support_force`, (R,).
    """

    def __init__(
        self, problem: Problem, vectors: Tensor, chosen: Cubature | None, lift: LinearSolver | None
    ) -> None:
        """Reduce a body to V (N, D, R) and to the chosen cells; None: all cells."""
        self.problem, self.lift = problem, lift
        white = vectors @ whitening(problem, vectors)
        every = torch.arange(len(problem.cells))
        cells, weights = (every, torch.ones(len(every))) if chosen is None else chosen[:2]
        self.cells = ReducedMesh(problem, white, cells, weights.double())
        self.stiffness = self.cells.product(self.cells.at_rest(), self.cells.basis)
        rank = vectors.shape[2]
        one = torch.eye(rank, dtype=torch.float64)
        self.stiffness_error = one - self.cells.basis.T @ self.stiffness
        self._white_rows = white.flatten(0, 1)
        self.reduced_support_force = self.project(problem.support_force)

    def project(self, force: Tensor) -> Tensor:
        """Return W^T f, (R,), of f (N, D)."""
        return force.flatten() @ self._white_rows

    def internal(self, force: Tensor, y: Tensor) -> Tensor:
        """Return the reduced internal force of the body, (R,), from that of the chosen cells."""
        return force + self.stiffness_error @ y

    def displacement(self, y: Tensor) -> Tensor:
        """Return the displacement (N, D) of coordinates in W."""
        return (self._white_rows @ y).view(self.problem.shape)

    def reduce(self, force: Tensor) -> ReducedLoad:
        """Return a load (N, D) in reduced coordinates."""
        problem = self.problem
        reduced, pull = self.project(force), self.reduced_support_force
        scale = norm(reduced - pull)
        offset, moves = problem.prescribed, self.lift is not None or problem.moved_supports
        if self.lift is not None:
            offset = offset + _linear_solution(self.lift, force - problem.support_force)
            pull = reduced
        cell_offset = offset[self.cells.nodes].flatten() if moves else offset
        error = pull - cell_offset @ self.stiffness if moves else pull
        scale = scale if scale > 0 else 1.0
        return ReducedLoad(reduced, scale, moves, offset, cell_offset, pull, error)

    def state(self, load: ReducedLoad, y: Tensor, offset_factor: float) -> ReducedState:
        """Return the evaluated state at coordinates y (R,) with a part of the offset."""
        cells = self.cells
        values = cells.basis @ y
        if load.has_offset:
            values += offset_factor * load.cell_offset
        field = cells.field(values)
        force, volume = cells.problem.evaluate(field)
        internal = self.internal(cells.project(force), y)
        if load.has_offset:
            internal += offset_factor * load.offset_error
        return ReducedState(y, offset_factor, field, internal, float(volume))

    def relative_residual(self, load: ReducedLoad, state: ReducedState, target: float) -> float:
        """Return the reduced relative residual under `target` times a load."""
        return norm(target * load.force - state.internal) / (target * load.scale)

    def tangent(
        self, load: ReducedLoad, state: ReducedState, target: float, jump: float
    ) -> tuple[Tensor | None, Tensor]:
        """Return the inverse of the tangent, None if singular, and the right-hand side of a step.

        Args:
            load: The load.
            state: The state.
            target: Load factor.
            jump: Part of the offset that the step adds.
        """
        cells = self.cells
        if state.at_rest:
            right = target * (load.force - load.offset_force)
            return torch.eye(len(state.y), dtype=torch.float64), right
        system = cells.problem.linearise(state.cell_displacement, state.gap)
        if not system.valid:
            system = cells.problem.linearise(state.cell_displacement)
        upper = cells.tangents(system.tangent[0])
        right = target * load.force - self.internal(cells.project(system.force), state.y)
        if load.has_offset:
            right -= state.offset_factor * load.offset_error
        if jump:
            pull = cells.project(cells.product(upper, load.cell_offset))
            right -= jump * (pull + load.offset_error)
        inverse, failed = torch.linalg.inv_ex(cells.reduced(upper) + self.stiffness_error)
        return (None if failed else inverse), right

    def update_strain_gap(self, state: ReducedState, new: ReducedState) -> ReducedState:
        """Return the state after a step with the strain gap of its mixed integration points."""
        problem = self.cells.problem
        if not problem.material.has_response:
            return new
        update = (new.cell_displacement - state.cell_displacement) / new.length
        u = new.cell_displacement
        return new._replace(gap=problem.update_strain_gap(state.gap, new.length, update, u))


def broyden(inverse: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """Return the updated inverse, which maps the change of the force to the step that caused it.

    Source: Broyden (1965), Math. Comp. 19, the first method in Sherman's and Morrison's form.
    """
    predicted = inverse @ change
    scale = step @ predicted
    if not scale.abs() > 1e-8 * step.norm() * predicted.norm():
        return inverse
    return inverse + torch.outer((step - predicted) / scale, step @ inverse)


def norm(vector: Tensor) -> float:
    """Return the Euclidean norm of a vector (R,), without overflow or underflow of squares."""
    largest = float(vector.abs().amax())
    if not 0 < largest < math.inf:
        return largest
    return largest * float(torch.linalg.vector_norm(vector / largest))


def refuse_range(problem: Problem) -> None:
    """Raise a ValueError if the law has ranges."""
    for name, ends in problem.material.parameter_ranges.items():
        raise ValueError(
            f"{name} = {list(ends)} must be one number, because reduced stiffness and cells "
            "depend on it; use Problem.with_parameters or dpl.fem.Newton"
        )


def beyond_linear(problem: Problem, snapshots: Tensor, lift: LinearSolver | None) -> Tensor:
    """Return equilibria (S, N, D) minus their linear solutions at free DOFs, (S, n)."""
    rest = snapshots[:, problem.free].double()
    if lift is not None:
        for row, u in zip(rest, snapshots, strict=True):
            force = problem.evaluate(u[None]).internal[0] - problem.support_force
            row -= _linear_solution(lift, force)[problem.free]
    return rest


def _linear_solution(lift: LinearSolver, force: Tensor) -> Tensor:
    """Return K(0)^-1 f, (N, D), to `LIFT_TOL`; the subspace corrects the error."""
    problem = lift.problem
    return problem.extend(lift.factor.solve(problem.restrict(force), LIFT_TOL))

"""Hyper-reduced POD-Galerkin: Newton in the coordinates of a subspace on few weighted cells."""

import math
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from dpl.fem import LinearSolver, Problem
from dpl.fem.rom.ecsw import Cubature, ReducedMesh, cubature, whitening
from dpl.fem.rom.pod import pod
from dpl.fem.solvers.newton import LoadStepping

TOL = 1e-5  # reduced relative residual at which the iterations stop [-]
MAX_ITER = 30  # for one part of a load
MAX_TOTAL_ITER = 400
MIN_LOAD_STEP = 2.0**-10
MIN_DETF_RATIO = 0.2  # a step must leave this part of min det F [-]
FACTOR_REUSE_TOL = 0.1  # reduced relative residual below which an inverse tangent is reused [-]
LIFT_TOL = 1e-6  # relative residual of the linear solution to which the subspace adds [-]
STATES = 256  # evenly spaced snapshots from which the cells are chosen


class Reduced(NamedTuple):
    """Solution in reduced coordinates."""

    displacement: Tensor  # displacement over L, (N, D) [-]
    residual: float  # reduced relative residual under the whole load [-]
    load_factor: float  # part of the load for which a reduced equilibrium was found [-]


class _Load(NamedTuple):
    """A load in reduced coordinates."""

    force: Tensor  # W^T f, (R,)
    scale: float  # norm of the residual at rest
    offset: Tensor  # displacement to which the subspace adds at full load, (N, D)
    cell_offset: Tensor  # offset at the cells' nodes, (C A D,)
    offset_error: Tensor  # difference of `force` and W^T K(0) offset of the cells, (R,)


class _State(NamedTuple):
    """An evaluated iterate."""

    y: Tensor  # coordinates in W, (R,)
    factor: float  # part of the offset that is applied [-]
    cell_displacement: Tensor  # displacement of the cells, (1, C A, D)
    internal: Tensor  # reduced internal force, (R,)
    volume_ratio: float  # min det F of the cells [-]
    length: float = 1.0  # length of the step that led here, 1 for a full one
    gap: Any = None  # strain gap of the mixed integration points, see `Problem.update_strain_gap`


class PODGalerkin:
    """Galerkin projection of the equilibrium onto a subspace: u = offset + V c, V^T R(u) = 0.

    The offset is the linear solution K(0)^-1 f with the motion of supports, so that V only has to
    contain the nonlinear part.

    Sums over all cells are sums over a few weighted ones, except for their linear part:
    V^T f_int(u) = V^T K(0) u + sum_e w_e V_e^T (f_e(u) - K_e(0) u_e). These forces derive from an
    energy, and are exact for small loads.

    Newton's method shortens steps and applies load steps as `dpl.fem.Newton` does. An inverse
    tangent is reused with Broyden updates while the residual halves. The reduced relative residual
    is ||L^-1 V^T R|| / ||L^-1 V^T f|| with L L^T = V^T K(0) V: to first order the relative error in
    the energy norm within the subspace.

    Source: Farhat, Avery, Chapman, Cortial (2014), Int. J. Numer. Methods Eng. 98 (ECSW).

    Attributes:
        problem: The body.
        lift: Its linear solver.
        chosen: The weighted cells.
        cells: Their mesh, with the basis W = V L^-T in which K(0) is the identity.
    """

    def __init__(
        self, problem: Problem, vectors: Tensor, chosen: Cubature, lift: LinearSolver
    ) -> None:
        """Reduce a body to orthonormal V (N, D, R), zero at fixed DOFs, and to weighted cells."""
        self.problem, self.lift, self.chosen = problem, lift, chosen
        white = vectors @ whitening(problem, vectors)
        self.cells = ReducedMesh(problem, white, chosen.cells, chosen.weights.double())
        at_rest = self._cell_tangents(self.cells.problem.stiffness_at_rest())
        self._stiffness = _product(at_rest, self.cells.basis)
        self._identity = torch.eye(vectors.shape[2], dtype=torch.float64)
        self._stiffness_error = self._identity - self.cells.basis.T @ self._stiffness
        self._rows = white.flatten(0, 1)
        self._single = self.cells.basis.float()

    @classmethod
    def fit(
        cls, problem: Problem, snapshots: Tensor, rank: int, *, tolerance: float, lift: LinearSolver
    ) -> Self:
        """Return the solver with basis and cells computed from equilibria (S, N, D) [-].

        The subspace has the dimension `rank`; `tolerance` is that of `cubature`.
        """
        for name, ends in problem.material.parameter_ranges.items():
            raise ValueError(
                f"{name} = {list(ends)} must be one number, because reduced stiffness and cells "
                "depend on it; use Problem.with_parameters"
            )
        if problem.follower_loads:
            raise ValueError(f"{cls.__name__} has no {problem.follower_loads.kinds}")
        snapshots = snapshots.double()
        linear = torch.zeros_like(snapshots)
        for row, u in zip(linear, snapshots, strict=True):
            force = problem.evaluate(u[None]).internal[0] - problem.support_force
            row += _linear_solution(lift, force)
        nonlinear = (snapshots - linear)[:, problem.free]
        basis = pod(nonlinear, rank).vectors
        vectors = torch.zeros(*problem.shape, rank, dtype=torch.float64)
        vectors[problem.free] = basis
        count = min(STATES, len(snapshots))
        some = torch.linspace(0, len(snapshots) - 1, count).round().long()
        projected, part = snapshots[some].clone(), nonlinear[some]
        projected[:, problem.free] -= part - (part @ basis) @ basis.T
        return cls(problem, vectors, cubature(problem, vectors, projected, tolerance), lift)

    def reduced(self, force: Tensor) -> Reduced:
        """Return the equilibrium in the subspace under a force (N, D) [-].

        Where none is found, it is that under the largest part of the load for which one was.
        """
        load = self._reduce(force)
        state = self._state(load, torch.zeros_like(load.force), 0.0)
        steps, iterations = LoadStepping(MIN_LOAD_STEP), 0
        while steps.factor < 1 and not steps.exhausted and iterations < MAX_TOTAL_ITER:
            end, count = self._newton(load, state, steps.target)
            iterations += count
            if end is None:
                steps.reject()
            else:
                state = end
                steps.accept()
        u = (self._rows @ state.y).view(self.problem.shape)
        return Reduced(
            displacement=u.add_(load.offset, alpha=steps.factor),
            residual=_residual(load, state, 1.0),
            load_factor=steps.factor,
        )

    def _newton(self, load: _Load, state: _State, target: float) -> tuple[_State | None, int]:
        """Return the equilibrium under `target` times a load, None without one; iterations."""
        inverse, ratio, before = None, _residual(load, state, target), math.inf
        for k in range(MAX_ITER):
            jump = target - state.factor
            if inverse is None or jump or not ratio < min(FACTOR_REUSE_TOL, before / 2):
                inverse, right = self._tangent(load, state, target, jump)
                if inverse is None:
                    return None, k
            else:
                right = target * load.force - state.internal
            step = inverse @ right
            new = self._update(load, state, step, jump, target)
            if new is None:
                return None, k + 1
            before, ratio = ratio, _residual(load, new, target)
            if new.factor == target:
                is_short = not jump and float(step.norm()) < 1e-2 * TOL * target * load.scale
                if ratio < TOL or is_short:
                    return new, k + 1
            if ratio >= FACTOR_REUSE_TOL:
                new = self._with_strain_gap(state, new)
            elif not jump:
                inverse = _broyden(inverse, new.y - state.y, new.internal - state.internal)
            state = new
        return None, MAX_ITER

    def _update(
        self, load: _Load, state: _State, step: Tensor, jump: float, target: float
    ) -> _State | None:
        """Return the state after the longest of the steps 1, 1/2, ... that inverts no cell."""
        bound = MIN_DETF_RATIO * min(state.volume_ratio, 1.0)
        for length in (0.5**k for k in range(10)):
            factor = target if length == 1 else state.factor + length * jump
            after = self._state(load, state.y + length * step, factor)
            if after.volume_ratio > bound:
                return after._replace(length=length)
        return None

    def _reduce(self, force: Tensor) -> _Load:
        """Return a load (N, D) in reduced coordinates."""
        support = self.problem.support_force
        reduced = force.flatten() @ self._rows
        scale = float(((force - support).flatten() @ self._rows).norm())
        offset = self.problem.prescribed + _linear_solution(self.lift, force - support)
        cell_offset = offset[self.cells.nodes].flatten()
        error = reduced - cell_offset @ self._stiffness
        return _Load(reduced, scale if scale > 0 else 1.0, offset, cell_offset, error)

    def _state(self, load: _Load, y: Tensor, factor: float) -> _State:
        """Return the evaluated state at coordinates y (R,) with a part of the offset."""
        cells = self.cells
        values = cells.basis @ y + factor * load.cell_offset
        field = values.view(1, *cells.problem.shape)
        force, volume = cells.problem.evaluate(field)
        internal = self._internal(load, force, y, factor)
        return _State(y, factor, field, internal, float(volume))

    def _internal(self, load: _Load, force: Tensor, y: Tensor, factor: float) -> Tensor:
        """Return the reduced internal force of the body, (R,), from that of the chosen cells."""
        of_cells = force.flatten() @ self.cells.basis
        return of_cells + self._stiffness_error @ y + factor * load.offset_error

    def _cell_tangents(self, entries: Tensor) -> Tensor:
        """Return U, (C, A D, A D), with U + U^T the cells' matrices, of their entries (nnz,)."""
        size = self.cells.basis.shape[0] // len(self.chosen.cells)
        row, column = torch.triu_indices(size, size)
        upper = entries.new_zeros(len(self.chosen.cells), size, size)
        upper[:, row, column] = entries.view(-1, len(row)) * torch.where(row == column, 0.5, 1.0)
        return upper

    def _tangent(
        self, load: _Load, state: _State, target: float, jump: float
    ) -> tuple[Tensor | None, Tensor]:
        """Return the inverse tangent, None if singular, and the right-hand side of a step."""
        cells = self.cells
        if state.factor == 0 and not state.y.any():  # at rest: K(0) and the linear solution
            return self._identity, torch.zeros_like(state.y)
        system = cells.problem.linearise(state.cell_displacement, state.gap)
        if not system.valid:
            system = cells.problem.linearise(state.cell_displacement)
        upper = self._cell_tangents(system.tangent[0])
        right = target * load.force - self._internal(load, system.force, state.y, state.factor)
        pull = _product(upper, load.cell_offset).flatten() @ cells.basis
        right -= jump * (pull + load.offset_error)
        rows = self._single.view(*upper.shape[:2], -1)  # float32 in half the time of float64
        product = self._single.T @ (upper.float() @ rows).flatten(0, 1)
        tangent = (product + product.T).double() + self._stiffness_error
        inverse, failed = torch.linalg.inv_ex(tangent)
        return (None if failed else inverse), right

    def _with_strain_gap(self, state: _State, new: _State) -> _State:
        """Return the state after a step with the strain gap of its mixed integration points."""
        problem = self.cells.problem
        if not problem.material.has_response:
            return new
        u = new.cell_displacement
        update = (u - state.cell_displacement) / new.length
        return new._replace(gap=problem.update_strain_gap(state.gap, new.length, update, u))


def _residual(load: _Load, state: _State, target: float) -> float:
    """Return the reduced relative residual under `target` times a load."""
    return float((target * load.force - state.internal).norm()) / (target * load.scale)


def _product(upper: Tensor, values: Tensor) -> Tensor:
    """Return (U + U^T) v of cells, (C A D, k) or (C A D,), of U (C, A D, A D)."""
    v = values.view(*upper.shape[:2], -1)
    return (upper @ v + upper.mT @ v).view_as(values)


def _broyden(inverse: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """Return the updated inverse, which maps the change of the force to the step that caused it.

    Source: Broyden (1965), Math. Comp. 19, the first method in Sherman's and Morrison's form.
    """
    predicted = inverse @ change
    scale = step @ predicted
    if not scale.abs() > 1e-8 * step.norm() * predicted.norm():
        return inverse
    return inverse + torch.outer((step - predicted) / scale, step @ inverse)


def _linear_solution(lift: LinearSolver, force: Tensor) -> Tensor:
    """Return K(0)^-1 f, (N, D), to `LIFT_TOL`; the subspace corrects the error."""
    problem = lift.problem
    return problem.extend(lift.factor.solve(problem.restrict(force), LIFT_TOL))

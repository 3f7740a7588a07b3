"""Newton's method in a subspace: a fast correction of predictions."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from scipy.linalg import lapack, solve_triangular
from scipy.linalg.blas import dnrm2  # without under- or overflow of squares
from torch import Tensor

from dpl.fem.options import check_options, option
from dpl.fem.problem import Evaluation, Problem
from dpl.fem.rom.ecsw import Cubature, cubature
from dpl.fem.rom.sampled_tangent import Array, SampledTangent, Single
from dpl.fem.solvers.solution import Load, Solution, check_tol, evaluate_solution, run_lockstep

MIN_DAMPING = 2.0**-4  # smallest damping factor [-]
MIN_DETF_RATIO = 0.2  # a step must leave this part of min det F [-]
MAX_SHIFT = 1e-4  # distance from the minimum of the energy to which steps converge, over ||u|| [-]
LEAST_EIGENVALUE = 1e-2  # of an indefinite reduced tangent relative to that at rest [-]

_Correction = tuple[Array, Callable[[Array], Array], Array]  # in W; from a residual; its shift


class SubspaceState(NamedTuple):
    """An evaluated displacement under one load."""

    displacement: Tensor  # u, (1, N, D) [-]
    evaluation: Evaluation  # internal force and min det F at u
    error: float  # estimated within the subspace over ||u|| [-]; infinite if an element is inverted
    iterations: int  # number of steps so far


@dataclass(frozen=True, eq=False)
class SubspaceNewton:
    """Newton's method for V^T R(u + V s) = 0: u is any displacement, V a basis of few modes.

    A step solves (V^T K(u) V) s = V^T (f - f_int(u)). The force is that of the whole body, and so
    min det F and residual of each iterate are known exactly. The tangent comes from few weighted
    cells, see `SampledTangent`, which affects the speed of convergence and not the result. Where it
    is indefinite, as far from equilibrium under large rotations, it is made positive definite. The
    part of the error outside the subspace remains.

    The norm of a Newton correction, ||s||, estimates the error within the subspace. Steps follow
    until this estimate, relative to ||u||, falls below `error_tol`.

    A step is accepted if no element is inverted and the restricted natural monotonicity test holds:
    the correction from the new residual with the same tangent must be shorter than (1 - d/4) ||s||,
    where d = 1, 1/2, 1/4, ... is the damping factor, the first that passes. If none does, the
    correction is computed with the tangent of all cells; if none does then, the iteration ends. The
    last iterate is the one with the smallest estimate; by this measure it is never worse than the
    guess, for any guess.

    The error in the Euclidean norm is not bounded by this. Steps converge to the minimum of the
    energy within the subspace, and stiff errors outside the subspace cause soft ones in it. Choose
    the number of modes such that held-out loads improve. With `gains` M, fitted to guesses of one
    kind, each correction is increased by M s_0, where s_0 is the first one, so that the steps
    converge to this distance from the minimum. M s_0 is limited to `MAX_SHIFT` times ||u||.

    Source: Deuflhard (2011), Newton Methods for Nonlinear Problems, section 3.3 (error-oriented
    descent; algorithm NLEQ-ERR); Nocedal, Wright (2006), Numerical Optimization, section 3.4
    (eigenvalue modification).

    Attributes:
        problem: The body; its law may have ranges.
        vectors: V, orthonormal, zero at fixed degrees of freedom, (N, D, R) [-].
        cubature: Weighted cells of the tangent; None: the tangent of the whole body.
        tol: Relative residual below which a solution counts as converged [-], see
            `Problem.relative_residual_of`; at least 1e-15, below 1.
        error_tol: Estimated relative error within the subspace at which the steps end [-]. Products
            with V in float32 resolve errors down to about 1e-7.
        max_iter: Largest number of steps.
        gains: M, (R, R) [-]; None: zero.

    Raises:
        ValueError: At the first load, if the body has rigid body modes.
    """

    problem: Problem
    vectors: Tensor
    cubature: Cubature | None = None
    tol: float = 1e-8
    error_tol: float = option("", default=2e-5, above=0, most=1)
    max_iter: int = option("", default=4, least=0)
    gains: Tensor | None = None

    @classmethod
    def within(
        cls,
        problem: Problem,
        vectors: Tensor,
        states: Tensor,
        *,
        tolerance: float = 3e-2,
        candidates: Tensor | None = None,
        **options: Any,
    ) -> Self:
        """Return the solver in a given subspace, with cells chosen at some states.

        Args:
            problem, vectors, options: Attributes of the solver.
            states: Displacements in equilibrium, (S, N, D) [-].
            tolerance, candidates: Arguments of `cubature`.
        """
        cells = cubature(problem.reference, vectors, states, tolerance, candidates)
        return cls(problem, vectors, cells, **options)

    def __post_init__(self) -> None:
        check_tol(self.tol)
        check_options(self)
        found, wanted = tuple(self.vectors.shape), (*self.problem.shape, "R")
        if len(found) != 3 or found[:2] != wanted[:2]:
            raise ValueError(f"vectors.shape = {found} must be {wanted}")
        if self.vectors[~self.problem.free].any():
            raise ValueError("vectors must be zero at fixed degrees of freedom")

    def iterate(self, load: Load, *, guess: Tensor | None = None) -> Iterator[Solution]:
        """Yield the guess and the state after each step; loads in lockstep.

        Args:
            load: The load.
            guess: Displacement to start from, (B, N, D) [-]; None: zero, except at supports.
        """
        loads = load.unbatch()
        if guess is None:
            guess = self.problem.prescribed.expand(len(loads), -1, -1)
        pairs = zip(loads, guess.split(1), strict=True)
        yield from run_lockstep([self._solutions(single, u) for single, u in pairs])

    def _solutions(self, load: Load, guess: Tensor) -> Iterator[Solution]:
        start = time.perf_counter()
        for state in self.states(load, guess=guess):
            count = state.iterations
            solution = evaluate_solution(
                self.problem, state.displacement, load, self.tol,
                iterations=count, from_guess=True, evaluation=state.evaluation,
                seconds=time.perf_counter() - start,
            )  # fmt: skip
            yield solution._replace(factorisations=torch.tensor([count]))
            if solution.converged:
                return

    def states(
        self,
        load: Load,
        *,
        guess: Tensor,
        evaluation: Evaluation | None = None,
        error_tol: float | None = None,
        max_iter: int | None = None,
        is_over: Callable[[], bool] = lambda: False,
    ) -> Iterator[SubspaceState]:
        """Yield the guess and the state after each step under one load, with estimated errors.

        Residual norms and status are not computed.

        Args:
            load, guess: The load, B = 1, and the displacement to start from, (1, N, D) [-].
            evaluation: Internal force and min det F at the guess, if known. The guess must then
                have the displacement of the supports.
            error_tol, max_iter: Replace the attributes of the solver.
            is_over: Called before each evaluation of the residual and each tangent of all cells.
                If it returns True, a step ends, and the states do after the last complete step.
        """
        error_tol = self.error_tol if error_tol is None else error_tol
        max_iter = self.max_iter if max_iter is None else max_iter

        def is_last(state: SubspaceState) -> bool:
            return state.iterations >= max_iter or state.error <= error_tol

        problem = self.problem.with_parameters(load.parameters)
        if evaluation is None:
            guess = torch.where(problem.free, guess, problem.prescribed)
            evaluation = problem.evaluate(guess)
        state = SubspaceState(guess, evaluation, math.inf, 0)
        correction = self._correction(problem, load, state)
        if correction is not None:
            state = state._replace(error=self._relative(correction[0], guess))
        yield state
        best = state
        while correction is not None and not is_last(state):
            following, shift = self._step(problem, load, state, correction, is_over), correction[2]
            if following is None and self.cubature is not None and not is_over():
                correction = self._correction(problem, load, state, shift, whole=True)
                if correction is not None:
                    following = self._step(problem, load, state, correction, is_over)
            if following is None:
                break
            yield (state := following)
            best = state if state.error < best.error else best
            if is_last(state) or is_over():
                break
            correction = self._correction(problem, load, state, shift)
        if best is not state:
            yield best._replace(iterations=state.iterations)

    def _correction(
        self, problem: Problem, load: Load, state: SubspaceState, shift: Array | None = None,
        *, whole: bool = False,
    ) -> _Correction | None:  # fmt: skip
        """Return Newton's correction, None where an element is inverted; `whole`: of all cells."""
        if not state.evaluation.volume_ratio > 0:
            return None
        right = self._reduced_residual(load, state.evaluation)
        tangent = self.tangent.at(problem, state.displacement[0], whole=whole)
        solve = _factorised(tangent)
        y = solve(right)
        if not np.isfinite(y).all():
            return None
        added = self._shift(y, state.displacement) if shift is None else shift
        return y + added, lambda right: solve(right) + added, added

    def _shift(self, y: Array, displacement: Tensor) -> Array:
        """Return M s_0 in coordinates of W, (R,), of the first correction (R,)."""
        if self.gains is None:
            return np.zeros_like(y)
        shift: Array = self._gains @ y
        return shift * min(1.0, MAX_SHIFT / max(self._relative(shift, displacement), 1e-300))

    def _step(
        self,
        problem: Problem,
        load: Load,
        state: SubspaceState,
        correction: _Correction,
        is_over: Callable[[], bool],
    ) -> SubspaceState | None:
        """Return the state after the longest acceptable step, None if none was found in time."""
        full, solve, _ = correction
        product = torch.from_numpy(_scaled_product(self.tangent.rows, full))
        size, update = self._norm(full), product.view(self.problem.shape)
        lowest = MIN_DETF_RATIO * min(float(state.evaluation.volume_ratio), 1.0)
        damping = 1.0
        while damping >= MIN_DAMPING and not is_over():
            u = state.displacement + damping * update
            evaluation = problem.evaluate(u)
            if evaluation.volume_ratio > lowest:
                y = solve(self._reduced_residual(load, evaluation))
                if self._norm(y) < (1 - damping / 4) * size:
                    return SubspaceState(u, evaluation, self._relative(y, u), state.iterations + 1)
            damping /= 2
        return None

    def _reduced_residual(self, load: Load, evaluation: Evaluation) -> Array:
        """Return W^T (f - f_int), (R,); NaN if it is not finite."""
        residual = (load.force[0] - evaluation.internal[0]).flatten().numpy()
        return _scaled_product(self.tangent.rows.T, residual)

    def _norm(self, y: Array) -> float:
        """Return ||s|| of coordinates y in W."""
        return float(dnrm2(self.tangent.scale @ y))

    def _relative(self, y: Array, displacement: Tensor) -> float:
        """Return ||s|| / ||u||; zero if both are, infinite if only u is zero."""
        size, whole = self._norm(y), float(dnrm2(displacement.flatten().numpy()))
        return size / whole if whole else math.inf if size else 0.0

    def prepare(self) -> None:
        """Compute what all loads share and load the loops, so that the first one does not wait."""
        rest = torch.zeros(self.problem.shape, dtype=torch.float64)
        self.tangent.at(self.problem.reference, rest)
        self._shift(np.zeros(self.vectors.shape[2]), rest)

    @cached_property
    def _gains(self) -> Array:
        """M in coordinates of W, (R, R)."""
        assert self.gains is not None
        scale = self.tangent.scale
        return solve_triangular(scale, self.gains.numpy() @ scale)

    @cached_property
    def tangent(self) -> SampledTangent:
        """The reduced tangent."""
        return SampledTangent(self.problem, self.vectors, self.cubature)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without cached properties."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def _factorised(matrix: Array) -> Callable[[Array], Array]:
    """Return the product with the inverse of a tangent, made positive definite.

    Eigenvalues up to `LEAST_EIGENVALUE` become one, which they are at rest. The products of a
    matrix that is not finite are NaN.
    """
    symmetric = (matrix + matrix.T) / 2
    factor, failed = lapack.dpotrf(symmetric, lower=1, clean=0)
    if not failed:
        return lambda right: lapack.dpotrs(factor, right, lower=1)[0]
    if not np.isfinite(symmetric).all():
        return lambda right: np.full_like(right, np.nan)
    values, axes = np.linalg.eigh(symmetric)
    inverse = 1 / np.where(values > LEAST_EIGENVALUE, values, 1.0)
    return lambda right: axes @ (inverse * (right @ axes))


def _scaled_product(matrix: Single, vector: Array) -> Array:
    """Return A v in float32, NaN if v is not finite; v is scaled so that no v is too small."""
    largest = float(np.abs(vector).max())
    if not 0 < largest < math.inf:
        return np.full(len(matrix), 0.0 if largest == 0 else np.nan)
    return largest * (matrix @ (vector / largest).astype(np.float32)).astype(np.float64)

"""Estimate of the error of a displacement by one corotational correction."""

import math
from typing import NamedTuple

import numpy as np
from torch import Tensor

from dpl.fem import LinearSolver, Load, Newton
from dpl.fem.problem import Evaluation
from dpl.fem.rom.subspace_newton import scaled_norm

RTOL = 1e-2  # relative residual of iterative solves for an estimate [-]
SUFFICIENT = 2e-3  # steps leave an error of 1e-3 in the modes, and about as much outside [-]


class ErrorEstimate(NamedTuple):
    """Estimated error of a displacement.

    Attributes:
        error: Estimated relative error [-].
        correction: The `corotational_correction` behind it, (1, N, D) [-]; None if there is none.
    """

    error: float
    correction: Tensor | None = None


def corotational_correction(
    solver: LinearSolver, load: Load, displacement: Tensor, evaluation: Evaluation | None = None
) -> Tensor | None:
    """Return M R(u), (1, N, D) [-], an approximation of Newton's correction of a displacement.

    M is the inverse of K(0) in the rotated frames of the nodes at u. The correction costs one
    residual and one solve with a stored factor. If the law has parameters, K(0) is that at the
    centre of their ranges, so that no load needs a new factor.

    The result is None if an element is inverted or u is not finite.

    Source: Mueller, Dorsey, McMillan, Jagnow, Cutler (2002), Stable real-time deformations, section
    3.2 (rotated factor).

    Args:
        solver: Linear solver of the body with the factor of K(0).
        load: The load, B = 1.
        displacement: u, (1, N, D) [-].
        evaluation: Internal force and min det F at u, if known.
    """
    problem = solver.problem.with_parameters(load.parameters)
    internal, volume = evaluation or problem.evaluate(displacement)
    right = problem.restrict((load.force - internal)[0])
    if not bool(volume > 0) or not np.isfinite(right).all():
        return None
    return problem.extend(solver.reference.corotational.at(displacement).solve(right, RTOL))[None]


def corotational_error(
    solver: LinearSolver, load: Load, displacement: Tensor, evaluation: Evaluation | None = None
) -> float:
    """Return ||M R(u)|| / ||u|| [-], an estimate of the relative error of a displacement.

    M R(u) is the `corotational_correction`. Unlike the residual the estimate does not depend on the
    stiffness of the body against the error.

    The estimate is infinite if an element is inverted, if u is not finite, or if u is zero and not
    in equilibrium.

    Source: Deuflhard (2011), Newton Methods for Nonlinear Problems, section 3.3 (corrections as
    error estimates).

    Args:
        solver, load, displacement, evaluation: See `corotational_correction`.
    """
    return _relative(corotational_correction(solver, load, displacement, evaluation), displacement)


def estimate_error(
    solver: LinearSolver,
    load: Load,
    displacement: Tensor,
    evaluation: Evaluation | None = None,
    *,
    in_modes: float = math.inf,
    sufficient: float = SUFFICIENT,
) -> ErrorEstimate:
    """Return the estimated relative error of a displacement, with the correction behind it.

    The error is the smaller one of `corotational_error` and an estimate in the modes of a model.
    The former is not computed if the latter is small enough.

    Args:
        solver, load, displacement, evaluation: See `corotational_correction`.
        in_modes: Newton's correction in the modes, relative to the displacement, plus the known
            error outside of them [-]; infinite if the latter is unknown, or known for other loads.
        sufficient: Estimate in the modes up to which that is the result [-].
    """
    if in_modes <= sufficient:
        return ErrorEstimate(in_modes)
    correction = corotational_correction(solver, load, displacement, evaluation)
    return ErrorEstimate(min(in_modes, _relative(correction, displacement)), correction)


def nearest(newton: Newton, load: Load, guesses: list[Tensor]) -> Tensor:
    """Return the guess (1, N, D) with the smallest estimated distance from equilibrium.

    The distance is the ||M R(u)|| of `corotational_error`. It is infinite for a guess that inverts
    an element or is not finite.

    Args:
        newton: Newton's method, whose factor of K(0) is used.
        load: The load, B = 1.
        guesses: Displacements, (1, N, D) [-] each.
    """
    corrections = [corotational_correction(newton.linear_solver, load, one) for one in guesses]
    return guesses[min(range(len(guesses)), key=lambda k: _norm(corrections[k]))]


def _norm(correction: Tensor | None) -> float:
    """Return the norm of a correction; infinite if there is none."""
    return math.inf if correction is None else scaled_norm(correction.numpy().ravel())


def _relative(correction: Tensor | None, displacement: Tensor) -> float:
    """Return the norm of a correction over that of the displacement, see `corotational_error`."""
    size, whole = _norm(correction), scaled_norm(displacement.numpy().ravel())
    if whole == 0 or size == math.inf:
        return math.inf if size else 0.0
    return size / whole

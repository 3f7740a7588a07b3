"""Estimate of the error of a displacement by one corotational correction."""

import math

import numpy as np
from torch import Tensor

from dpl.fem import LinearSolver, Load, Newton
from dpl.fem.problem import Evaluation
from dpl.fem.rom.subspace_newton import scaled_norm

RTOL = 1e-2  # relative residual of iterative solves for an estimate [-]
SUFFICIENT = 2e-3  # steps leave an error of 1e-3 in the modes, and about as much outside [-]


def corotational_error(
    solver: LinearSolver, load: Load, displacement: Tensor, evaluation: Evaluation | None = None
) -> float:
    """Return ||M R(u)|| / ||u|| [-], an estimate of the relative error of a displacement.

    M is the inverse of K(0) in the rotated frames of the nodes at u. M R(u) approximates Newton's
    correction for the cost of one residual and one solve with a stored factor. Unlike the residual
    it does not depend on the stiffness of the body against the error. If the law has parameters,
    K(0) is that at the centre of their ranges, so that no load needs a new factor.

    The estimate is infinite if an element is inverted, if u is not finite, or if u is zero and not
    in equilibrium.

    Source: Deuflhard (2011), Newton Methods for Nonlinear Problems, section 3.3 (corrections as
    error estimates); Mueller, Dorsey, McMillan, Jagnow, Cutler (2002), Stable real-time
    deformations, section 3.2 (rotated factor).

    Args:
        solver: Linear solver of the body with the factor of K(0).
        load: The load, B = 1.
        displacement: u, (1, N, D) [-].
        evaluation: Internal force and min det F at u, if known.
    """
    correction = _correction_norm(solver, load, displacement, evaluation)
    whole = scaled_norm(displacement.numpy().ravel())
    if whole == 0 or correction == math.inf:
        return math.inf if correction else 0.0
    return correction / whole


def estimate_error(
    solver: LinearSolver,
    load: Load,
    displacement: Tensor,
    evaluation: Evaluation | None = None,
    *,
    in_modes: float = math.inf,
    sufficient: float = SUFFICIENT,
) -> float:
    """Return the estimated relative error of a displacement [-].

    It is the smaller one of `corotational_error` and an estimate in the modes of a model. The
    former is not computed if the latter is small enough.

    Args:
        solver, load, displacement, evaluation: See `corotational_error`.
        in_modes: Newton's correction in the modes, relative to the displacement, plus the known
            error outside of them [-]; infinite if the latter is unknown, or known for other loads.
        sufficient: Estimate in the modes up to which that is the result [-].
    """
    if in_modes <= sufficient:
        return in_modes
    return min(in_modes, corotational_error(solver, load, displacement, evaluation))


def nearest(newton: Newton, load: Load, guesses: list[Tensor]) -> Tensor:
    """Return the guess (1, N, D) with the smallest estimated distance from equilibrium.

    The distance is the ||M R(u)|| of `corotational_error`. It is infinite for a guess that inverts
    an element or is not finite.

    Args:
        newton: Newton's method, whose factor of K(0) is used.
        load: The load, B = 1.
        guesses: Displacements, (1, N, D) [-] each.
    """
    return min(guesses, key=lambda guess: _correction_norm(newton.linear_solver, load, guess))


def _correction_norm(
    solver: LinearSolver, load: Load, displacement: Tensor, evaluation: Evaluation | None = None
) -> float:
    """Return ||M R(u)|| [-]; infinite if an element is inverted or u is not finite."""
    problem = solver.problem.with_parameters(load.parameters)
    internal, volume = evaluation or problem.evaluate(displacement)
    right = problem.restrict((load.force - internal)[0])
    if not bool(volume > 0) or not np.isfinite(right).all():
        return math.inf
    return scaled_norm(solver.reference.corotational.at(displacement).solve(right, RTOL))

"""Estimate of the error of a displacement by a few conjugate gradient steps of Newton's method."""

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dnrm2  # without under- or overflow of squares
from torch import Tensor

from dpl.fem.linear.interface import Array
from dpl.fem.linear.krylov import binary_unit, krylov_steps
from dpl.fem.problem import Evaluation
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.solution import Load

RTOL = 1e-2  # relative residual of iterative solves for an estimate [-]
PRODUCTS = 3  # largest number of products with the tangent
MANY_PRODUCTS = 30  # the same on thin bodies, where M is not near the inverse of the tangent
REST = 0.03  # part of the correction, bounding the rest of it, at which the steps end [-]
NEAR = 0.1  # relative residual below which negative curvature is that of the equilibrium [-]
DOUBT = 3.0  # factor of the estimate where negative curvature is that of spurious stresses
LINEAR = 1e-4  # relative correction up to which R is linear along it [-]
DIFFERENCE = 1e-5  # change of u, relative to u, by which products are computed [-]


class ErrorEstimate(NamedTuple):
    """Estimated error of a displacement."""

    error: float  # estimated relative error [-]
    correction: Tensor | None = None  # the correction behind it, (1, N, D) [-]
    is_indefinite: bool = False  # the tangent has negative curvature near equilibrium


def estimate_error(
    solver: LinearSolver,
    load: Load,
    displacement: Tensor,
    evaluation: Evaluation | None = None,
    *,
    products: int = PRODUCTS,
) -> ErrorEstimate:
    """Return the estimated relative error of a displacement, with the correction behind it.

    Newton's correction K(u)^-1 R is approximated by conjugate gradients, preconditioned by M, the
    inverse of K(0) in the rotated frames of the nodes at u. The error after k steps is at most
    ||z|| / t, with z = M (R - K(u) x) and the smallest eigenvalue t of M K(u), which the smallest
    Ritz value approximates from above. t is small where the load softens the body; Newton's
    correction is then too short. With s = min(t, 1) the estimate is (2 - s) (||x|| + ||z|| / s)
    over ||u||. Steps are made until ||z|| / s is at most `REST` times ||x||. Above `LINEAR`, the
    residual that the correction leaves decides: ||z|| is then at least ||M R(u + x)||.

    A step costs one residual, which differs by K(u) times its direction, and one solve with the
    stored factor of K(0). If the law has parameters, this is the factor at the centre of their
    ranges, so that no load needs a new one.

    The estimate is infinite if an element is inverted at u or by the correction, if u is not
    finite, and if u is zero and not in equilibrium. The correction is None if u is inverted or not
    finite. If a step finds negative curvature, the estimate is infinite where the relative residual
    is below `NEAR`: an equilibrium near u is unstable or near a critical load. Where the residual
    is larger, stresses of the error itself cause it, and the estimate is `DOUBT` ||M R|| / ||u||.
    Without a known law the estimate is NaN.

    Source: Deuflhard (2011), Newton Methods for Nonlinear Problems, section 3.3 (corrections as
    error estimates); Mueller, Dorsey, McMillan, Jagnow, Cutler (2002), Stable real-time
    deformations, section 3.2 (rotated factor).

    Args:
        solver: Linear solver of the body with the factor of K(0).
        load, displacement: The load, B = 1, and u, (1, N, D) [-].
        evaluation: Internal force and min det F at u, if known.
        products: Largest number of steps; with 0 the estimate is ||M R|| / ||u||, too small where
            the load softens the body.
    """
    problem = solver.problem.with_parameters(load.parameters)
    if not problem.material.is_known:
        return ErrorEstimate(math.nan)
    internal, volume = evaluation or problem.evaluate(displacement)
    right = problem.restrict((load.force - internal)[0])
    size = dnrm2(displacement.numpy().ravel())
    if not bool(volume > 0) or not np.isfinite(right).all():
        return ErrorEstimate(math.inf)
    inverse = solver.reference.corotational.at(displacement)

    def product(direction: Array) -> Array:
        length = DIFFERENCE * size / dnrm2(direction)
        moved = problem.evaluate(displacement + length * problem.extend(direction)[None])
        return problem.restrict((moved.internal - internal)[0]) / length

    unit = binary_unit(right)
    steps = krylov_steps(product, lambda part: inverse.solve(part, RTOL), right / unit)
    for k, step in enumerate(steps):
        made = step.solution if k else step.preconditioned
        correction = problem.extend(unit * made)[None]
        if k == 0:
            first = dnrm2(made)
        if not (ritz := step.ritz) > 0:
            is_near = bool(problem.relative_residual_of(internal, load.force) < NEAR)
            error = math.inf if is_near else DOUBT * unit * first / size
            return ErrorEstimate(error, correction, is_indefinite=is_near)
        least, length = min(ritz, 1.0), dnrm2(step.solution)
        rest = dnrm2(step.preconditioned) / least
        if size == 0 or k == products or rest <= REST * length:
            break
    if k and unit * (length + rest) > LINEAR * size:
        better = problem.evaluate(displacement + correction)
        left = problem.restrict((load.force - better.internal)[0]) / unit
        if not bool(better.volume_ratio > 0):
            return ErrorEstimate(math.inf, correction)
        rest = max(rest, dnrm2(inverse.solve(left, RTOL)) / least)
    distance = (2 - least) * (length + rest)
    if size == 0:
        return ErrorEstimate(math.inf if distance else 0.0, correction)
    return ErrorEstimate(unit * distance / size, correction)

"""Answers of the simulator and their summaries in words."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from dpl.fem import Solution, Status
from dpl.fem.loads.family import MAX_DISTANCE
from dpl.inference.request import Candidate, Request
from dpl.scene import Scene

ROUNDOFF = 1e-9  # relative error of amplitudes [-]
UNRELIABLE = 0.1  # estimated error from which a grasp is reported [-]
UNKNOWN = 0.995  # estimated error from which the displacement is called unknown [-]
LEAST_PERCENTAGE = 1e-4  # smallest estimated error that is given in per cent [-]


@dataclass(frozen=True)
class Answer:
    """A displacement with its quality; for several loads each field is an array, (B, ...).

    Attributes:
        displacement: (N, D) [m], a NumPy array or a tensor as the force.
        residual: ||R_free|| / ||f||, evaluated at the displacement [-], see
            `Problem.relative_residual_of`.
        error: Estimated relative error of the displacement [-], see `estimate_error`: no bound. A
            model that `HasCorrection`, such as `unrolled`, states it for loads in range. Infinite
            if an element is inverted or the prediction is not finite.
        volume_ratio: min det F [-]; an element is inverted if it is not above 0.
        converged: True if the residual is below the tolerance of the call (without one, that of
            the scene) and no element is inverted. It is False also where rounding does not allow
            this residual. The estimated error has no part in it.
        negative_pivots: Number of negative eigenvalues of the tangent; 1 if there are some, not
            counted; -1: not examined.
        amplitude: Size of the load over the largest of the training [-]; outside of the range of
            sizes, 1 plus the distance from it over the largest size, see `LoadFamily.project`.
        out_of_span: Norm of the part of the force that no load of the training explains, over that
            of the force [-]; NaN if the load family cannot recognise its loads.
        out_of_distribution: True if the load lies outside the training range, as far as known.
        method: Method that computed the result: "rest", "linear", "prediction", "corrected",
            "hybrid" or "full Newton".
        iterations: Linear solves with a tangent.
        milliseconds: Wall time [ms]; of several loads, the share of each.
        summary: Estimated error, residual, stability and range in words.
    """

    displacement: Any
    residual: Any
    error: Any
    volume_ratio: Any
    converged: Any
    negative_pivots: Any
    amplitude: Any
    out_of_span: Any
    out_of_distribution: Any
    method: Any
    iterations: Any
    milliseconds: Any
    summary: Any


def fields_of(
    best: Candidate, place: tuple[float, float, bool], request: Request, scene: Scene
) -> tuple[Any, ...]:
    """Return the fields of `Answer` for one solution; `place` is its `RangeCheck`."""
    state, error = best.state, best.known_error
    residual, converged = float(state.residual), best.is_exact
    kept = converged and residual < request.residual_tol(scene)
    rest = best.method == "rest" and converged
    words = "no load: at rest" if rest else summarise(state, kept, error, *place)
    displacement = scene.length * state.displacement[0]
    numbers = residual, error, float(state.volume_ratio), kept, int(state.negative_pivots)
    counts = best.method, int(state.iterations), request.milliseconds
    return (displacement, *numbers, *place, *counts, words)


def summarise(
    state: Solution,
    kept: bool,
    error: float,
    amplitude: float,
    out_of_span: float,
    outside: bool,
) -> str:
    """Return the summary of one solution in words: error, residual, stability and range.

    Args:
        state: The solution.
        kept: The residual is below the tolerance.
        error: Estimated relative error of the displacement [-].
        amplitude, out_of_span: See `Answer`.
        outside: The load is out of the training range.
    """
    if not float(state.volume_ratio) > 0:
        words = "NOT VALID: an element is inverted"
    else:
        words = f"{_accuracy(error)}, residual {float(state.residual):.1e} of the load"
        if kept:
            words += " (converged)"
        elif state.converged:
            words += ", the least that rounding allows"
        words += ", nothing inverted"
    if bool(state.converged):
        pivots = int(state.negative_pivots)
        if pivots > 0:
            words += f", UNSTABLE ({pivots} negative eigenvalues)"
        else:
            words += ", stable" if pivots == 0 else ", stability not examined"
    elif int(state.negative_pivots) > 0:
        words += ", the tangent has negative curvature: near or beyond a critical load"
    if int(state.status) == Status.NO_VALID_EQUILIBRIUM:
        words += f"; no equilibrium found beyond {float(state.load_factor):.2f} of the load"
    if not outside:
        return words + "; the load family cannot recognise its loads" * math.isnan(out_of_span)
    if out_of_span > MAX_DISTANCE:
        return words + f"; {out_of_span:.0%} of the load is unlike the training's"
    if amplitude > 1 + ROUNDOFF:
        off = f"{amplitude - 1:.2g} times the training's largest"
        return words + f"; the size of the load is out of range by {off}"
    return words + "; a modulus lies outside the training's range"


def _accuracy(error: float) -> str:
    """Return an estimated relative error in words."""
    if not error < UNKNOWN:
        return "displacement unknown, its estimated error exceeds 100 %"
    return f"displacement within about {relative(error)} (estimated)"


def relative(error: float) -> str:
    """Return a relative error as text, in percent unless it is very small."""
    return f"{100 * error:.2g} %" if error >= LEAST_PERCENTAGE else f"{error:.1e}"


def answer_of(rows: Sequence[tuple[Any, ...]], *, numpy: bool, single: bool) -> Answer:
    """Return the answer to one load or several, in NumPy or torch as the force was given.

    Args:
        rows: Fields of `Answer` for each load: a tensor (N, D), then numbers and texts.
        numpy: Return NumPy arrays.
        single: Return the fields of the only load, without a leading axis.
    """
    displacements, *columns = zip(*rows, strict=True)
    if single:
        values = [column[0] for column in columns]
    else:
        values = [np.array(column) for column in columns]
        if not numpy:
            values = [torch.from_numpy(x) if x.dtype.kind != "U" else x.tolist() for x in values]
    displacement = displacements[0] if single else torch.stack(displacements)
    if numpy:
        return Answer(displacement.numpy(), *values)
    return Answer(displacement.clone(), *values)  # an ordinary tensor, not one of inference

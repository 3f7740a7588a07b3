"""Answers of the simulator, their summaries in words, and the range of the training."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
import torch

from dpl.fem import Load, Solution, Status
from dpl.fem.loads.family import MAX_DISTANCE
from dpl.inference.request import Candidate, Request
from dpl.scene import Scene
from dpl.training import TrainedSurrogate

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
            `Problem.relative_residual_of`; NaN, as `error` is, if the law of the body is unknown.
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


class RangeCheck(NamedTuple):
    """Position of a load relative to the range of the training."""

    amplitude: float  # as of `Answer` [-]
    out_of_span: float  # as of `Answer` [-]
    outside: bool  # the load is known to be out of range

    @classmethod
    def of(cls, surrogate: TrainedSurrogate, load: Load) -> list[Self]:
        """Return the positions of loads relative to the range of a surrogate's scene."""
        loads = surrogate.scene.loads
        inputs = list(zip(load.parameters.unbind(1), loads.parameter_ranges.values(), strict=True))
        if surrogate.predictor.reads_young:
            inputs.append((load.young, loads.moduli))
        amplitudes, distances = (column.tolist() for column in loads.project(load.force))
        places = []
        for k, (amplitude, out_of_span) in enumerate(zip(amplitudes, distances, strict=True)):
            outside = amplitude > 1 + ROUNDOFF or out_of_span > MAX_DISTANCE
            outside |= any(not low <= float(values[k]) <= high for values, (low, high) in inputs)
            places.append(cls(amplitude, out_of_span, outside))
        return places

    @property
    def inside(self) -> bool:
        """True where the load is known to be in range."""
        return not (self.outside or math.isnan(self.out_of_span))


def answer_of(best: Candidate, place: RangeCheck, request: Request, scene: Scene) -> Answer:
    """Return the answer of a solution of one load, whose displacement is a tensor."""
    state, error, milliseconds = best.state, best.known_error, request.milliseconds
    residual = float(state.residual)
    kept = best.is_exact and residual < request.residual_tol(scene)
    rest = best.method == "rest" and best.is_exact
    words = "no load: at rest" if rest else summarise(state, kept, error, place)
    numbers = residual, error, float(state.volume_ratio), kept, int(state.negative_pivots)
    counts = best.method, int(state.iterations), milliseconds
    return Answer(scene.length * state.displacement[0], *numbers, *place, *counts, words)


def stacked(answers: Sequence[Answer], *, numpy: bool) -> Answer:
    """Return the answers to B loads as one, with arrays of NumPy or with tensors and lists."""
    columns = {name: [vars(one)[name] for one in answers] for name in vars(answers[0])}
    displacement = torch.stack(columns.pop("displacement"))
    arrays = {name: np.array(column) for name, column in columns.items()}
    if numpy:
        return Answer(displacement.numpy(), **arrays)
    return Answer(displacement.clone(), **{
        name: column.tolist() if column.dtype.kind == "U" else torch.from_numpy(column)
        for name, column in arrays.items()
    })  # fmt: skip


def summarise(state: Solution, kept: bool, error: float, place: RangeCheck) -> str:
    """Return estimated error, residual (`kept`: below the tolerance), stability and range."""
    if not float(state.volume_ratio) > 0:
        words = "NOT VALID: an element is inverted"
    else:
        words = "displacement unknown, its estimated error exceeds 100 %"
        if error < UNKNOWN:
            words = f"displacement within about {relative(error)} (estimated)"
        words += f", residual {float(state.residual):.1e} of the load"
        if math.isnan(error):
            words = "residual and error of the displacement unknown, as is the law"
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
    if not place.outside:
        unknown = math.isnan(place.out_of_span)
        return words + "; the load family cannot recognise its loads" * unknown
    if place.out_of_span > MAX_DISTANCE:
        return words + f"; {place.out_of_span:.0%} of the load is unlike the training's"
    if place.amplitude > 1 + ROUNDOFF:
        off = f"{place.amplitude - 1:.2g} times the training's largest"
        return words + f"; the size of the load is out of range by {off}"
    return words + "; a modulus lies outside the training's range"


def relative(error: float) -> str:
    """Return a relative error as text, in percent unless it is very small; NaN is unknown."""
    if math.isnan(error):
        return "unknown"
    return f"{100 * error:.2g} %" if error >= LEAST_PERCENTAGE else f"{error:.1e}"

"""Learning curve: held-out errors against the number of training loads."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

POINTS = 4  # last points of a curve that the power law is fitted to
MIN_EXPONENT = 0.05  # slower decay predicts nothing
MAX_LOADS = 10**9  # larger predictions are not given


class CurvePoint(NamedTuple):
    """Held-out errors of a fit.

    Attributes:
        loads: Number of training loads.
        seconds: Wall time since the start of the training [s].
        median, worst: Median and maximum over held-out loads of the relative L2 error [-].
        e_mean: See `dpl.training.metrics.METRICS` [-].
    """

    loads: int
    seconds: float
    median: float
    worst: float
    e_mean: float

    def __str__(self) -> str:
        """Return the point in words."""
        errors = {"median": self.median, "worst": self.worst, "e_mean": self.e_mean}
        return f"{self.loads} loads, {self.seconds:.0f} s: {in_words(errors)}"


def loads_for(points: Sequence[CurvePoint], error: float) -> int | None:
    """Return the number of loads at which a median error is expected; None if there is none.

    A power law, error = a loads^-b, is fitted to the last points by least squares of logarithms.
    """
    last = [point for point in points[-POINTS:] if point.median > 0]
    if len(last) < 2 or not all(math.isfinite(point.median) for point in last):
        return None
    loads = np.log([point.loads for point in last])
    if np.ptp(loads) == 0:
        return None
    slope, offset = np.polyfit(loads, np.log([point.median for point in last]), 1)
    if slope > -MIN_EXPONENT:
        return None
    exponent = (math.log(error) - offset) / slope
    return math.ceil(math.exp(exponent)) if exponent < math.log(MAX_LOADS) else None


def describe(points: Sequence[CurvePoint], error: float) -> str:
    """Return the last point in words, and the number of loads that an error is expected to need."""
    last = points[-1]
    if last.median <= error:
        return f"{last}; target of {_percent(error)} reached"
    needed = loads_for(points, error)
    if needed is None:
        return str(last)
    needed = round(float(f"{max(needed, last.loads + 1):.2g}"))
    return f"{last}; about {needed} loads for {_percent(error)}"


def in_words(errors: Mapping[str, float]) -> str:
    """Return the `median`, `worst` and `e_mean` of a fit in words."""
    median, worst = _percent(errors["median"]), _percent(errors["worst"])
    return f"median {median}, worst {worst}, e_mean {errors['e_mean']:.1e}"


def _percent(ratio: float) -> str:
    return f"{100 * ratio:.2g} %"

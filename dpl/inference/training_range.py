"""Position of loads relative to the range of the training."""

import math
from typing import NamedTuple, Self

from dpl.fem import Load
from dpl.fem.loads.family import MAX_DISTANCE
from dpl.inference.answer import ROUNDOFF
from dpl.training import TrainedSurrogate


class RangeCheck(NamedTuple):
    """Position of a load relative to the range of the training.

    Attributes:
        amplitude: Size of the load over the largest of the training, above 1 outside of its range
            [-], see `LoadFamily.project`.
        out_of_span: Relative part of the force that no load of the training explains [-]; NaN if
            the load family cannot recognise its loads.
        outside: Whether the load is known to be out of range.
    """

    amplitude: float
    out_of_span: float
    outside: bool

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

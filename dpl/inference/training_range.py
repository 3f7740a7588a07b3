"""Position of loads relative to the range of the training."""

from collections.abc import Sequence
from typing import NamedTuple, Self

from torch import Tensor

from dpl.fem import Load
from dpl.fem.loads.family import MAX_DISTANCE
from dpl.inference.answer import ROUNDOFF
from dpl.training import TrainedSurrogate


class RangeCheck(NamedTuple):
    """Position of loads relative to the range of the training.

    Attributes:
        amplitude: Size of the load over the largest of the training, above 1 outside of its range,
            (B,) [-], see `LoadFamily.project`.
        out_of_span: Relative part of the force that no load of the training explains, (B,) [-]; NaN
            if the load family cannot recognise its loads.
        outside: Whether the load is known to be out of range, (B,).
    """

    amplitude: Tensor
    out_of_span: Tensor
    outside: Tensor

    @classmethod
    def of(cls, surrogate: TrainedSurrogate, load: Load) -> Self:
        """Return the position of loads relative to the range of a surrogate's scene."""
        amplitude, out_of_span = surrogate.scene.loads.project(load.force)
        outside = (amplitude > 1 + ROUNDOFF) | (out_of_span > MAX_DISTANCE)
        for values, (low, high) in _inputs(surrogate, load):
            outside |= (values < low) | (values > high)
        return cls(amplitude, out_of_span, outside)

    @property
    def is_known(self) -> Tensor:
        """True where the load family recognises its loads, (B,)."""
        return ~self.out_of_span.isnan()

    @property
    def inside(self) -> Tensor:
        """True where the load is known to be in range, (B,)."""
        return self.is_known & ~self.outside

    def split(self) -> list[Self]:
        """Return the positions one by one, B = 1."""
        if len(self.outside) == 1:
            return [self]
        columns = zip(*(column.split(1) for column in self), strict=True)
        return [type(self)(*column) for column in columns]


def _inputs(
    surrogate: TrainedSurrogate, load: Load
) -> Sequence[tuple[Tensor, tuple[float, float]]]:
    """Return the moduli (B,) that are inputs of the network, each with its range."""
    loads = surrogate.scene.loads
    pairs = list(zip(load.parameters.unbind(1), loads.parameter_ranges.values(), strict=True))
    return [*pairs, (load.young, loads.moduli)] if surrogate.predictor.reads_young else pairs

"""Position of loads relative to the range of the training."""

from typing import NamedTuple, Self

import torch
from torch import Tensor

from dpl.fem import Load
from dpl.inference.answer import MAX_OUT_OF_SPAN, ROUNDOFF
from dpl.training import Surrogate


class RangeCheck(NamedTuple):
    """Position of loads relative to the range of the training.

    Attributes:
        amplitude: Largest modal load over the largest of the training, (B,) [-].
        out_of_span: Relative part of the force outside the modes of the training, (B,) [-].
        outside: Whether the load is out of range, (B,).
    """

    amplitude: Tensor
    out_of_span: Tensor
    outside: Tensor

    @classmethod
    def of(cls, surrogate: Surrogate, load: Load) -> Self:
        """Return the position of loads relative to the range of a surrogate's scene."""
        amplitude, out_of_span = surrogate.scene.loads.project(load.force)
        outside = (amplitude > 1 + ROUNDOFF) | (out_of_span > MAX_OUT_OF_SPAN)
        return cls(amplitude, out_of_span, outside | _has_parameter_outside(surrogate, load))

    def split(self) -> list[Self]:
        """Return the positions one by one, B = 1."""
        columns = zip(*(column.split(1) for column in self), strict=True)
        return [type(self)(*column) for column in columns]


def _has_parameter_outside(surrogate: Surrogate, load: Load) -> Tensor:
    """Return True for loads with an input modulus of the network out of range, (B,)."""
    loads, takes = surrogate.scene.loads, getattr(surrogate.net, "extra_inputs", ())
    pairs = list(zip(load.parameters.T, loads.parameter_ranges.values(), strict=True))
    if "young" in takes:
        pairs.append((load.young, loads.young_range))
    outside = torch.zeros(len(load.force), dtype=torch.bool)
    for values, (low, high) in pairs:
        outside |= (values < low) | (values > high)
    return outside

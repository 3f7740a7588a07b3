"""Ranges of parameters, of which each load has a value."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Self

from torch import Tensor

DISTRIBUTIONS = ("uniform", "log")


class ParameterRange(tuple[float, float]):
    """Smallest and largest value of a parameter, with the distribution of the values of loads.

    Attributes:
        is_log: True if the logarithm of the values is uniform, else the values are.
    """

    is_log: bool

    def __new__(cls, low: float, high: float, *, is_log: bool = False) -> Self:
        """Return the range."""
        made = super().__new__(cls, (float(low), float(high)))
        made.is_log = is_log
        return made

    def __getnewargs_ex__(self) -> tuple[tuple[float, ...], dict[str, bool]]:
        """Return the arguments with which a copy is made."""
        return tuple(self), {"is_log": self.is_log}

    @classmethod
    def of(cls, name: str, value: Any) -> "ParameterRange":
        """Return the range of [low, high] or of {low, high, distribution}.

        Raises:
            ValueError: `value` is neither, or is out of order. The message begins with `name`.
        """
        if isinstance(value, ParameterRange):
            return value
        options = dict(value) if isinstance(value, Mapping) else {}
        ends = [options.pop("low", None), options.pop("high", None)] if options else list(value)
        distribution = options.pop("distribution", "uniform")
        numbers = [x for x in ends if isinstance(x, int | float) and math.isfinite(x)]
        if options or len(numbers) != 2 or len(ends) != 2 or not numbers[0] < numbers[1]:
            raise ValueError(
                f"{name} = {value} must be a range [low, high], low below high, or "
                "{low, high, distribution}"
            )
        if distribution not in DISTRIBUTIONS:
            raise ValueError(f"{name}.distribution = {distribution!r} must be uniform or log")
        if distribution == "log" and not numbers[0] > 0:
            raise ValueError(f"{name} = {value} must be above 0 for a logarithmic distribution")
        return cls(*numbers, is_log=distribution == "log")

    @property
    def middle(self) -> float:
        """Mean of the ends; their geometric mean if the distribution is logarithmic."""
        low, high = self
        return math.sqrt(low * high) if self.is_log else (low + high) / 2

    def at(self, t: Any) -> Any:
        """Return the values of numbers in [0, 1], of the same shape."""
        low, high = self
        return low * (high / low) ** t if self.is_log else low + (high - low) * t

    def normalise(self, values: Tensor) -> Tensor:
        """Return values mapped from the range to [-1, 1], by their logarithm if that is uniform."""
        low, high = self
        if self.is_log:
            low, high, values = math.log(low), math.log(high), values.log()
        return (2 * values - (low + high)) / (high - low)


def is_range(value: object) -> bool:
    """Return True for the value of a constant that is a range, perhaps an invalid one."""
    return isinstance(value, Mapping | Sequence) and not isinstance(value, str)

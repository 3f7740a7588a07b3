"""Ranges of parameters, of which each load has a value."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Self

from torch import Tensor

DISTRIBUTIONS = ("uniform", "log")
Young = float | Sequence[float] | Mapping[str, Any]  # a number, [low, high], or options of a range


class ParameterRange(tuple[float, float]):
    """Smallest and largest value of a parameter, with the distribution of the values of loads.

    Attributes:
        is_log: True if the logarithm of the values is uniform, else the values are.
    """

    is_log: bool

    def __new__(cls, low: float, high: float, *, is_log: bool = False) -> Self:
        made = super().__new__(cls, (float(low), float(high)))
        made.is_log = is_log
        return made

    def __eq__(self, other: object) -> bool:
        """Return True for a range, or a pair of numbers, with these ends and distribution."""
        return tuple.__eq__(self, other) is True and self.is_log == getattr(other, "is_log", False)

    def __ne__(self, other: object) -> bool:  # a tuple defines it by itself
        return not self == other

    __hash__ = tuple.__hash__

    def __getnewargs_ex__(self) -> tuple[tuple[float, ...], dict[str, bool]]:
        return tuple(self), {"is_log": self.is_log}

    @classmethod
    def of(cls, name: str, value: Any, *, is_modulus: bool = False) -> "ParameterRange":
        """Return the range of [low, high] or of {low, high, distribution}.

        The range of Young's moduli [Pa], `is_modulus`, may also be a number, or have low = high.
        """
        options = dict(value) if isinstance(value, Mapping) else {}
        ends = [options.pop("low", None), options.pop("high", None)] if options else value
        ends = list(ends) if isinstance(ends, Sequence) else [ends, ends]
        usual = "log" if getattr(value, "is_log", False) else "uniform"
        distribution = options.pop("distribution", usual)
        if distribution not in DISTRIBUTIONS:
            raise ValueError(f"{name}.distribution = {distribution!r} must be uniform or log")
        finite = [float(x) for x in ends if isinstance(x, int | float) and math.isfinite(x)]
        is_pair = len(finite) == len(ends) == 2 and not options
        low, high = finite if is_pair else (math.nan, math.nan)
        if is_modulus and not 0 < low <= high:
            raise ValueError(
                f"{name} = {value} must be a number, an ascending range [low, high] or "
                "{low, high, distribution}, above 0 [Pa]"
            )
        if not (low < high or is_modulus):
            raise ValueError(
                f"{name} = {value} must be a range [low, high], low below high, or "
                "{low, high, distribution}"
            )
        if distribution == "log" and not low > 0:
            raise ValueError(f"{name} = {value} must be above 0 for a logarithmic distribution")
        return cls(low, high, is_log=distribution == "log")

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
        """Return values mapped from the range to [-1, 1], by their logarithm if that is uniform.

        Without width, the value is mapped to 0, and twice it (by the logarithm e times it) to 1.
        """
        (low, high), half = self, self[1]
        if self.is_log:
            low, high, values, half = math.log(low), math.log(high), values.log(), 1.0
        return (2 * values - (low + high)) / ((high - low) or 2 * half)


def is_range(value: object) -> bool:
    """Return True for the value of a constant that is a range, perhaps an invalid one."""
    return isinstance(value, Mapping | Sequence) and not isinstance(value, str)

"""Young's modulus of random loads: one number, or a range with a distribution."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from dpl.fem.ranges import DISTRIBUTIONS, ParameterRange

Young = float | Sequence[float] | Mapping[str, Any]  # a number, [low, high], or options of a range


@dataclass(frozen=True)
class YoungRange:
    """Range of Young's moduli from which each load draws one.

    Attributes:
        low: Smallest modulus [Pa].
        high: Largest modulus [Pa]; equal to `low` for one modulus.
        distribution: "uniform": E is uniform in the range; "log": log E is.
    """

    low: float
    high: float
    distribution: str = "uniform"

    def __post_init__(self) -> None:
        """Check the range.

        Raises:
            ValueError: The range is empty or not positive, or there is no such distribution.
        """
        if self.distribution not in DISTRIBUTIONS:
            names = " or ".join(DISTRIBUTIONS)
            raise ValueError(f"young.distribution = {self.distribution!r} must be {names}")
        if not 0 < self.low <= self.high < math.inf:
            raise ValueError(
                f"young = [{self.low}, {self.high}] must be an ascending range above 0 [Pa]"
            )

    @classmethod
    def of(cls, young: Young) -> "YoungRange":
        """Return the range of a number [Pa], of [low, high] or of a mapping of the attributes.

        Raises:
            ValueError: `young` is none of these, or out of range.
        """
        if isinstance(young, Mapping):
            missing = [name for name in ("low", "high") if name not in young]
            unknown = sorted(map(str, young.keys() - {"low", "high", "distribution"}))
            for name in (*missing, *unknown):
                problem = "is missing" if name in missing else "does not exist"
                raise ValueError(f"young.{name} {problem}; it has low, high and distribution")
            distribution = young.get("distribution", "uniform")
            return cls(float(young["low"]), float(young["high"]), distribution)
        moduli = [young] * 2 if isinstance(young, int | float) else list(young)
        if len(moduli) != 2 or not 0 < moduli[0] <= moduli[1] < math.inf:
            raise ValueError(
                f"young = {young} must be a modulus above 0 [Pa], [low, high] or "
                "{low, high, distribution}"
            )
        return cls(float(moduli[0]), float(moduli[1]))

    @property
    def _range(self) -> ParameterRange:
        return ParameterRange(self.low, self.high, is_log=self.distribution == "log")

    @property
    def middle(self) -> float:
        """Mean of the ends of the range [Pa]; their geometric mean for "log"."""
        return self._range.middle

    def at(self, t: Tensor) -> Tensor:
        """Return the moduli [Pa] of numbers in [0, 1), of the same shape."""
        moduli: Tensor = self._range.at(t)
        return moduli.clamp(self.low, self.high) if self._range.is_log else moduli

    def normalise(self, young: Tensor) -> Tensor:
        """Return moduli [Pa] mapped from the range to [-1, 1], linearly in E or in log E.

        Without a range, the modulus is mapped to 0 and twice the modulus (uniform) or e times the
        modulus (log) to 1.
        """
        if self.distribution == "log":
            low, high = math.log(self.low), math.log(self.high)
            return (young.log() - (low + high) / 2) / ((high - low) / 2 or 1.0)
        return (young - (self.low + self.high) / 2) / ((self.high - self.low) / 2 or self.high)

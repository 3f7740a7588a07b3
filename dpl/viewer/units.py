"""Numbers in engineering notation: SI prefixes in steps of a thousand."""

import math
from typing import NamedTuple

PREFIXES = {-4: "p", -3: "n", -2: "µ", -1: "m", 0: "", 1: "k", 2: "M", 3: "G", 4: "T"}


class Unit(NamedTuple):
    """A unit with a prefix.

    Attributes:
        name: Name with the prefix, such as "kPa".
        factor: Size over the unit without prefix, such as 1000 [-].
    """

    name: str
    factor: float


def unit_for(value: float, unit: str) -> Unit:
    """Return the unit in which a value lies between 1 and 1000, rounded to three digits.

    Zero and values that are not finite keep the unit without prefix. `unit` has no prefix.
    """
    if not 0 < abs(value) < math.inf:
        return Unit(unit, 1.0)
    exponent = math.floor(math.log10(abs(float(f"{value:.2e}"))) / 3 + 1e-9)
    exponent = min(max(exponent, min(PREFIXES)), max(PREFIXES))
    return Unit(PREFIXES[exponent] + unit, 1000.0**exponent)


def unit_of_scale(top: float, unit: str) -> Unit:
    """Return the unit for a scale from 0 to `top`, in which values below `top` lie above 1."""
    return unit_for(0.99 * top, unit)


def engineering(value: float, unit: str) -> str:
    """Return a value with three digits and its unit, such as "1.25 kN" for 1250 and "N"."""
    name, factor = unit_for(value, unit)
    return f"{scaled(value, factor)} {name}"


def scaled(value: float, factor: float) -> str:
    """Return a value over a factor with three digits; whole numbers have no exponent."""
    number = float(f"{value / factor:.2e}")
    return f"{number:.0f}" if 100 <= abs(number) < 1e4 else f"{number:.3g}"


def round_step(low: float, high: float, *, steps: int = 200) -> float:
    """Return a power of ten that divides an interval into at least `steps` steps.

    The step is at least 1e-4 of the largest power of ten in the interval, so that values with this
    step have at most five digits. Equal ends, as of a fixed value, count as an interval from zero.
    """
    step = 10.0 ** math.floor(math.log10((high - low or abs(high)) / steps))
    return max(step, 10.0 ** (math.floor(math.log10(max(abs(low), abs(high)))) - 4))

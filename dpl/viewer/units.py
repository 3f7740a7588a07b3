"""Numbers in engineering notation: SI prefixes in steps of a thousand."""

import math

PREFIXES = {-4: "p", -3: "n", -2: "µ", -1: "m", 0: "", 1: "k", 2: "M", 3: "G", 4: "T"}


def unit_for(value: float, unit: str) -> tuple[str, float]:
    """Return a unit with prefix, such as "kPa", and its size, such as 1000 [-].

    In this unit the value lies between 1 and 1000, rounded to three digits. Zero and values that
    are not finite keep the unit without prefix.
    """
    if not 0 < abs(value) < math.inf:
        return unit, 1.0
    exponent = math.floor(math.log10(abs(float(f"{value:.2e}"))) / 3 + 1e-9)
    exponent = min(max(exponent, min(PREFIXES)), max(PREFIXES))
    return PREFIXES[exponent] + unit, 1000.0**exponent


def tick_labels(top: float, unit: str, count: int = 4) -> tuple[str, float, list[str]]:
    """Return unit with prefix, its size [-] and numbers of a scale from 0 to `top`, `count` + 1.

    The unit is that of the values below `top`, which lie above 1.
    """
    name, size = unit_for(0.99 * top, unit)
    return name, size, [scaled(top * k / count, size) for k in range(count + 1)]


def engineering(value: float, unit: str) -> str:
    """Return a value with three digits and its unit, such as "1.25 kN" for 1250 and "N"."""
    name, size = unit_for(value, unit)
    return f"{scaled(value, size)} {name}"


def scaled(value: float, size: float) -> str:
    """Return a value over the size of a unit with three digits; whole numbers have no exponent."""
    number = float(f"{value / size:.2e}")
    return f"{number:.0f}" if 100 <= abs(number) < 1e4 else f"{number:.3g}"


def round_step(low: float, high: float, *, steps: int = 200) -> float:
    """Return a power of ten that divides an interval into at least `steps` steps.

    The step is at least 1e-4 of the largest power of ten in the interval, so that values with this
    step have at most five digits. Equal ends, as of a fixed value, count as an interval from zero.
    """
    step = 10.0 ** math.floor(math.log10((high - low or abs(high)) / steps))
    return max(step, 10.0 ** (math.floor(math.log10(max(abs(low), abs(high)))) - 4))

"""Options of laws and load families: numbers and ranges with a unit and bounds."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, Field, field, fields
from typing import Any, NamedTuple

DIMENSIONLESS = ("", "times L")  # units of options that do not depend on the size of the body and E


class Bounds(NamedTuple):
    """Unit and bounds of an option."""

    unit: str
    least: float
    most: float
    above: float
    below: float
    nonzero: bool

    def condition(self, value: float | Sequence[float]) -> str | None:
        """Return the condition that a number or a range [low, high] does not meet, in words."""
        is_range = isinstance(value, Sequence)
        ends = [*value] if isinstance(value, Sequence) else [value, value]
        inside = (self.least <= x <= self.most and self.above < x < self.below for x in ends)
        if len(ends) != 2 or not ends[0] <= ends[1] or not all(inside):
            if self.above > -math.inf and self.below < math.inf:
                return f"lie between {self.above:g} and {self.below:g} (both excluded)"
            words = "a smallest and a largest number" if is_range else "a number"
            words += f" above {self.above:g}" if self.above > -math.inf else ""
            words += f" from {self.least:g}" if self.least > -math.inf else ""
            return f"be {words}" + (f" to {self.most:g}" if self.most < math.inf else "")
        return "contain a number other than 0" if self.nonzero and not any(ends) else None


def option(
    unit: str,
    *,
    default: Any = MISSING,
    least: float = -math.inf,
    most: float = math.inf,
    above: float = -math.inf,
    below: float = math.inf,
    nonzero: bool = False,
    optional: bool = False,
) -> Any:
    """Declare a field of a law or a load family: a number, or a range [low, high] of numbers.

    `Parametrised` and `RandomLoads` check that the numbers are finite and in the bounds, and that a
    range ascends. None is valid and means that the option is left out.

    Args:
        unit: SI unit, "times L" for multiples of the longest side, or "" for a pure number and for
            moduli in any unit.
        default: Value of the option if it is left out; an option without one must be given.
        least, most: Smallest and largest valid number.
        above, below: Numbers between which valid numbers lie.
        nonzero: Refuse the range [0, 0].
        optional: Leave the option out of identities where it has its default.
    """
    bounds = Bounds(unit, least, most, above, below, nonzero)
    return field(default=default, metadata={"bounds": bounds, "optional": optional})


def check_options(owner: Any) -> None:
    """Check the options of a dataclass that are declared by `option`."""
    for one, bounds in declared(owner):
        value = getattr(owner, one.name)
        if value is not None and (condition := bounds.condition(value)):
            unit = f" [{bounds.unit}]" if bounds.unit else ""
            null = ", or null" if one.default is None else ""
            raise ValueError(f"{one.name} = {shown(value)} must {condition}{unit}{null}")


def shown(value: float | Sequence[float]) -> float | list[float]:
    """Return the value of an option for a message, ranges as lists."""
    return list(value) if isinstance(value, Sequence) else value


def declared(owner: Any) -> Iterator[tuple[Field[Any], Bounds]]:
    """Yield the fields of a dataclass that are declared by `option`, with their bounds."""
    for one in fields(owner):
        if bounds := one.metadata.get("bounds"):
            yield one, bounds

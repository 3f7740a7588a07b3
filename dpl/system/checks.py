"""Checks of the ranges of arguments, and errors that name an argument."""

import math
from collections.abc import Iterator
from contextlib import contextmanager


def check_range(low: float, high: float = math.inf, /, **values: float) -> None:
    """Raise ValueError if a value, named by its keyword, is not in [low, high]."""
    for name, value in values.items():
        if not low <= value <= high:
            span = f"lie between {low:,} and {high:,}" if high < math.inf else f"be {low} or more"
            raise ValueError(f"{name} = {value} must {span}")


@contextmanager
def named_errors(place: str) -> Iterator[None]:
    """Turn errors of values and of files into a ValueError of one line that begins with a place."""
    try:
        yield
    except (ValueError, OSError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ValueError(f"{place}{' '.join(str(reason).split())}") from error

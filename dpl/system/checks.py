"""Checks of the ranges of arguments."""

import math


def check_range(low: float, high: float = math.inf, /, **values: float) -> None:
    """Raise ValueError if a value, named by its keyword, is not in [low, high]."""
    for name, value in values.items():
        if not low <= value <= high:
            span = f"lie between {low:,} and {high:,}" if high < math.inf else f"be {low} or more"
            raise ValueError(f"{name} = {value} must {span}")

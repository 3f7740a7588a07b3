"""Load stepping with automatic step size, and the guard against inverted elements."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar


@dataclass
class LoadStepping:
    """Load factors of an incremental solution.

    A step that fails is halved, a step that succeeds is doubled.

    Source: Wriggers (2008), Nonlinear Finite Element Methods, section 5.3.

    Attributes:
        min_step: Load step below which the solution is given up [-].
        factor: Largest load factor for which an equilibrium is known [-].
        step: Load step that is tried next [-].
    """

    min_step: float
    factor: float = 0.0
    step: float = 1.0

    @property
    def target(self) -> float:
        """Load factor at the end of the next step [-], 1 for the whole load."""
        return min(self.factor + self.step, 1.0)

    @property
    def exhausted(self) -> bool:
        """Whether the next step is below the smallest one allowed."""
        return self.step < self.min_step

    def accept(self) -> None:
        """Advance to the target and double the step."""
        self.factor, self.step = self.target, 2 * self.step

    def reject(self) -> None:
        """Halve the step."""
        self.step = (self.target - self.factor) / 2


State = TypeVar("State", bound=Any)


def longest_valid_step(
    state_after: Callable[[float], State], min_volume_ratio: float, *, halvings: int = 9
) -> State | None:
    """Return the state after the longest of the steps 1, 1/2, 1/4, ... that inverts no element.

    Args:
        state_after: Function from the length of a step, 1 for the full one, to the state after it,
            whose `volume_ratio` is min det F [-].
        min_volume_ratio: Bound that min det F has to exceed [-].
        halvings: Number of halvings of the step that are tried.

    Returns:
        None if the shortest step violates the bound too.
    """
    for k in range(halvings + 1):
        state = state_after(0.5**k)
        if state.volume_ratio > min_volume_ratio:
            return state
    return None

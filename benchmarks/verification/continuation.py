"""Equilibria along a path of bodies, such as a rising pressure."""

from collections.abc import Callable, Iterator, Sequence

from torch import Tensor

from benchmarks.verification.bodies import balanced
from dpl.fem import Newton, Problem


def follow(
    build: Callable[[float], Problem], values: Sequence[float], start: Tensor | None = None
) -> Iterator[Tensor]:
    """Yield the equilibria (1, N, D) [-] of the bodies at values of a parameter.

    Each solve starts from the secant of the two equilibria before it.

    Args:
        build: Returns the body at a value.
        values: The values, which ascend or descend.
        start: Displacement from which the first solve starts; None: rest.

    Raises:
        ArithmeticError: Newton does not converge.
    """
    known: list[tuple[float, Tensor]] = []
    for value in values:
        guess = known[-1][1] if known else start
        if len(known) > 1:
            (a, first), (b, last) = known[-2:]
            guess = last + (last - first) * (value - b) / (b - a)
        found = balanced(Newton(build(value)), guess=guess).displacement
        known.append((value, found))
        yield found

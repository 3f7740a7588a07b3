"""Stress: hard and hopeless things that are asked of the package, and whether it says what it does.

A case asks, an outcome tells what happened and is as expected, reported (it failed, and said so) or
silently wrong; only the last is a defect. Every state of every solve in the matrix is watched.
Sources of the numbers: table 2.2 of the verification dossier, typed in beside the cases.
"""

from collections.abc import Sequence

from benchmarks.stress import bodies, invalid_input, loads, networks, stability, trained_run
from benchmarks.stress.case import Case, Line, LoadLevel, Number, Outcome, Verdict, numbers, perform

__all__ = [
    "Case",
    "Line",
    "Number",
    "Outcome",
    "Rung",
    "Verdict",
    "matrix",
    "names",
    "numbers",
    "perform",
    "trained_run",
]


def matrix(wanted: Sequence[str] | None = None) -> list[Case]:
    """Return the cases of the mechanics and of stubs of networks.

    Args:
        wanted: Names of those; all if left out.

    Raises:
        ValueError: There is no case of a name.
    """
    themes = loads, bodies, invalid_input, stability, networks
    found = sorted((case for theme in themes for case in theme.cases()), key=_order)
    known = names(found)
    if unknown := [name for name in wanted or () if name not in known]:
        raise ValueError(f"{unknown[0]!r} is none of {', '.join(known)}")
    return [case for case in found if wanted is None or case.name in wanted]


def names(cases: Sequence[Case]) -> list[str]:
    """Return the names of cases, each once."""
    return list(dict.fromkeys(case.name for case in cases))


def _order(case: Case) -> int:
    return int(case.name[1:]) if case.name[1:].isdigit() else 99

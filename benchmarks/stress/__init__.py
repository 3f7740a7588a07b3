"""Stress cases: difficult and unsolvable tasks, and whether the package reports its results truly.

The outcome of a case is as expected, reported (a failure that the package reports itself) or
silently wrong; only the last is a defect. An auditor checks every state of every solve.
Reference numbers stand beside the cases. Where no source is named, they were computed by an
independent finite-element program in NumPy.
"""

from collections.abc import Sequence

from benchmarks.stress import bodies, invalid_input, loads, networks, stability
from benchmarks.stress.case import (
    Case,
    CaseResult,
    Comparison,
    LoadLevel,
    Outcome,
    Verdict,
    comparisons,
    run_case,
)


def select_cases(wanted: Sequence[str] | None = None) -> list[Case]:
    """Return the cases of the mechanics and of predictors that stand for networks."""
    themes = loads, bodies, invalid_input, stability, networks
    found = sorted((case for theme in themes for case in theme.cases()), key=_order)
    known = names(found)
    if unknown := [name for name in wanted or () if name not in known]:
        raise ValueError(f"{unknown[0]!r} is none of {', '.join(known)}")
    return [case for case in found if wanted is None or case.name in wanted]


def names(cases: Sequence[Case]) -> list[str]:
    """Return the distinct names of cases."""
    return list(dict.fromkeys(case.name for case in cases))


def _order(case: Case) -> int:
    return int(case.name[1:]) if case.name[1:].isdigit() else 99

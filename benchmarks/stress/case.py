"""Stress cases, their outcomes and how they are classified."""

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from benchmarks.stress.auditor import Auditor
from benchmarks.verification.report import Row
from dpl.system.threads import one_thread


class Verdict(StrEnum):
    """Classification of an outcome."""

    EXPECTED = "as expected"
    REPORTED = "reported"  # a failure reported by a value, a warning or an error
    WRONG = "silently wrong"


@dataclass(frozen=True)
class LoadLevel:
    """One load of a load sweep."""

    series: str  # name of the sweep
    amplitude: float  # load over the largest load of the training range [-]
    residual: float  # final relative residual ||R_free|| / ||f|| [-]
    volume_ratio: float  # smallest min det F of all states [-]
    iterations: int  # linear solves
    status: str  # final status
    # ||u - u*|| / ||u*|| against Newton's solution u* [-]; NaN if it was not computed
    error: float = math.nan


@dataclass(frozen=True)
class Outcome:
    """Result of a case."""

    observed: str  # description of what happened
    verdict: Verdict  # its classification
    rows: Sequence[Row] = ()  # measured numbers with their references
    levels: Sequence[LoadLevel] = ()  # loads of a load sweep, to be drawn


@dataclass(frozen=True)
class Case:
    """A difficult or unsolvable task for the package."""

    name: str  # identifier, T1 to T23 or "sweep"; the cases of one topic share it
    description: str  # the task
    expected: str  # the expected outcome
    run: Callable[[Auditor], Outcome]  # performs the task; the auditor checks all solves


@dataclass(frozen=True)
class CaseResult:
    """A case that was run, one row of cases.csv."""

    # case, description, expected: See `Case`
    case: str
    description: str
    expected: str
    # observed, verdict: See `Outcome`
    observed: str
    verdict: str
    solves: int  # number of solves
    states_checked: int  # number of states of these solves; the auditor checks all of them
    min_detF: float  # smallest min det F of the accepted states [-]; NaN without any
    seconds: float  # wall time [s]


@dataclass(frozen=True)
class Comparison:
    """A measured number and its reference, one row of numbers.csv; see `Row`."""

    case: str
    description: str
    quantity: str
    reference: str
    value: float
    difference: float
    holds: bool


def classify(
    observed: str,
    rows: Sequence[Row] = (),
    *,
    failures: Sequence[str] = (),
    levels: Sequence[LoadLevel] = (),
) -> Outcome:
    """Return an outcome; it is silently wrong where a row misses its reference.

    Rows are numbers of solutions that are reported as valid; failures are deviations from the
    expectation that the solutions themselves report.
    """
    missed = [
        f"{row.quantity} is {row.value:.6g} and not {row.reference}"
        for row in rows
        if not row.holds
    ]
    verdict = Verdict.WRONG if missed else Verdict.REPORTED if failures else Verdict.EXPECTED
    return Outcome("; ".join([*missed, *failures, observed]), verdict, rows, levels)


def expect_error(description: str, action: Callable[[], object], words: str) -> Outcome:
    """Return the outcome of an action that must raise a one-line error with these words."""
    try:
        action()
    except (ValueError, TypeError, MemoryError, OSError) as error:
        messages = str(error)
        right = words in messages and "\n" not in messages
        observed = f"{type(error).__name__}: {messages}"
        return classify(observed, failures=() if right else [f"{description}: not {words!r}"])
    return Outcome(f"{description}: no error", Verdict.WRONG)


def combine(outcomes: Sequence[Outcome]) -> Outcome:
    """Return several outcomes as one with the worst verdict."""
    order = [Verdict.EXPECTED, Verdict.REPORTED, Verdict.WRONG]
    worst = max((outcome.verdict for outcome in outcomes), key=order.index)
    shown = [o.observed for o in outcomes if worst == Verdict.EXPECTED or o.verdict == worst]
    rows = [row for outcome in outcomes for row in outcome.rows]
    levels = [level for outcome in outcomes for level in outcome.levels]
    return Outcome("; ".join(dict.fromkeys(shown)), worst, rows, levels)


def run_case(case: Case) -> tuple[CaseResult, Outcome]:
    """Return the result of a case; errors count as reported, violations as silently wrong."""
    auditor, start = Auditor(), time.perf_counter()
    with warnings.catch_warnings(), one_thread():
        warnings.simplefilter("ignore", UserWarning)  # cases that are about warnings record them
        try:
            outcome = case.run(auditor)
        except Exception as error:
            messages = str(error).partition("\n")[0]
            outcome = Outcome(f"{type(error).__name__}: {messages}", Verdict.REPORTED)
    if auditor.violations:
        observed = "; ".join([*dict.fromkeys(auditor.violations), outcome.observed])
        outcome = replace(outcome, observed=observed, verdict=Verdict.WRONG)
    line = CaseResult(
        case.name, case.description, case.expected, outcome.observed, str(outcome.verdict),
        auditor.solves, auditor.states_checked,
        auditor.min_detF if math.isfinite(auditor.min_detF) else math.nan,
        time.perf_counter() - start,
    )  # fmt: skip
    return line, outcome

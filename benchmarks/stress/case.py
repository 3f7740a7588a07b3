"""A stress case, what came of it, and the watch that is kept over every solve in it."""

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
    """What a case has shown."""

    EXPECTED = "as expected"
    REPORTED = "reported"  # it failed, and said so: in a value, a warning or an error
    WRONG = "silently wrong"


@dataclass(frozen=True)
class LoadLevel:
    """One load of a ladder.

    Attributes:
        series: Which ladder.
        amplitude: Load over the largest of the training range [-].
        residual: ||R_free|| / ||f|| where the solver ended [-].
        volume_ratio: Smallest min det F on the way and at the end [-].
        iterations: Linear solves.
        status: Of the end, in words.
        error: ||u - u*|| / ||u*|| against Newton's answer u* [-]; NaN where that is not asked.
    """

    series: str
    amplitude: float
    residual: float
    volume_ratio: float
    iterations: int
    status: str
    error: float = math.nan


@dataclass(frozen=True)
class Outcome:
    """What came of a case.

    Attributes:
        happened: In words.
        verdict: What it is worth.
        rows: Numbers beside their references.
        rungs: Loads of a ladder, to be drawn.
    """

    happened: str
    verdict: Verdict
    rows: Sequence[Row] = ()
    rungs: Sequence[LoadLevel] = ()


@dataclass(frozen=True)
class Case:
    """Something hard or hopeless that is asked of the package.

    Attributes:
        name: Its number in table 2.2 of the verification dossier (T1 to T23), or "ladder".
        what: Is asked.
        expected: What should happen.
        run: Does it; all solves go through the watch.
    """

    name: str
    what: str
    expected: str
    run: Callable[[Auditor], Outcome]


@dataclass(frozen=True)
class Line:
    """A case that was run, one row of the table.

    Attributes:
        case, what, expected: Of the case.
        happened, verdict: Of its outcome.
        solves: Answers that were asked for.
        iterates: States on the way to them, all of them seen by the watch.
        smallest: Smallest min det F of the states that Newton accepted [-]; NaN without any.
        seconds: Wall time [s].
    """

    case: str
    what: str
    expected: str
    happened: str
    verdict: str
    solves: int
    iterates: int
    smallest: float
    seconds: float


@dataclass(frozen=True)
class Number:
    """A number beside its reference, one row of the second table; see `Row`."""

    case: str
    what: str
    quantity: str
    reference: str
    value: float
    difference: float
    holds: bool


def classify(
    happened: str,
    rows: Sequence[Row] = (),
    *,
    fails: Sequence[str] = (),
    rungs: Sequence[LoadLevel] = (),
) -> Outcome:
    """Return an outcome: rows that miss are silently wrong, for nothing else said so.

    Args:
        happened: In words.
        rows: Numbers of answers that count as such.
        fails: What fell short of what is expected, and was said by the answer itself.
        rungs: Loads of a ladder.
    """
    missed = [
        f"{row.quantity} is {row.value:.6g} and not {row.reference}"
        for row in rows
        if not row.holds
    ]
    verdict = Verdict.WRONG if missed else Verdict.REPORTED if fails else Verdict.EXPECTED
    return Outcome("; ".join([*missed, *fails, happened]), verdict, rows, rungs)


def refused(what: str, action: Callable[[], object], words: str) -> Outcome:
    """Return whether an action ends with an error of one line that holds these words."""
    try:
        action()
    except (ValueError, TypeError, MemoryError, OSError) as error:
        told = str(error)
        right = words in told and "\n" not in told
        happened = f"{type(error).__name__}: {told}"
        return classify(happened, fails=() if right else [f"{what}: not {words!r}"])
    return Outcome(f"{what}: no error", Verdict.WRONG)


def all_of(outcomes: Sequence[Outcome]) -> Outcome:
    """Return several outcomes as one, as bad as the worst of them."""
    order = [Verdict.EXPECTED, Verdict.REPORTED, Verdict.WRONG]
    worst = max((outcome.verdict for outcome in outcomes), key=order.index)
    shown = [o.happened for o in outcomes if worst == Verdict.EXPECTED or o.verdict == worst]
    rows = [row for outcome in outcomes for row in outcome.rows]
    rungs = [rung for outcome in outcomes for rung in outcome.rungs]
    return Outcome("; ".join(dict.fromkeys(shown)), worst, rows, rungs)


def perform(case: Case) -> tuple[Line, Outcome]:
    """Return what came of a case; whatever it raises is reported, whatever is not so is wrong."""
    watch, start = Auditor(), time.perf_counter()
    with warnings.catch_warnings(), one_thread():
        warnings.simplefilter("ignore", UserWarning)  # cases that are about warnings record them
        try:
            outcome = case.run(watch)
        except Exception as error:
            told = str(error).partition("\n")[0]
            outcome = Outcome(f"{type(error).__name__}: {told}", Verdict.REPORTED)
    if watch.lies:
        happened = "; ".join([*dict.fromkeys(watch.lies), outcome.happened])
        outcome = replace(outcome, happened=happened, verdict=Verdict.WRONG)
    line = Line(
        case.name, case.what, case.expected, outcome.happened, str(outcome.verdict),
        watch.solves, watch.iterates,
        watch.smallest if math.isfinite(watch.smallest) else math.nan,
        time.perf_counter() - start,
    )  # fmt: skip
    return line, outcome


def numbers(case: Case, outcome: Outcome) -> list[Number]:
    """Return the numbers of an outcome as rows of a table."""
    return [
        Number(
            case.name, case.what, row.quantity, row.reference, row.value, row.difference, row.holds
        )
        for row in outcome.rows
    ]

"""Every stress case has the expected outcome; the command fails where one is silently wrong."""

import csv
from dataclasses import replace
from decimal import Decimal

import pytest

from benchmarks import stress
from benchmarks.stress import Case, Verdict, run_case, select_cases
from benchmarks.stress.case import classify

ROUNDED = ("T1", "T3", "T4", "T8", "T10")  # their references are rounded: the last digit is right


def marked(case: Case):
    is_long = case.name == "sweep" or (case.name == "T2" and "q = 1000 Pa" not in case.description)
    name, marks = f"{case.name}, {case.description}", [pytest.mark.slow] if is_long else []
    return pytest.param(case, marks=marks, id=name)


@pytest.mark.parametrize("case", map(marked, select_cases()))
def test_case_has_the_expected_outcome(case, in_process):
    """The sandbox of the files is tested in tests/fem/test_mesh_sandbox.py."""
    line, outcome = run_case(case)
    assert line.verdict == Verdict.EXPECTED, line.observed
    assert not line.min_detF <= 0
    if case.name in ROUNDED:
        for row in (row for row in outcome.rows if row.reference[0] not in "<>"):
            unit = 10.0 ** Decimal(row.reference).as_tuple().exponent
            assert abs(row.value - float(row.reference)) < 0.6 * unit, row


def test_a_load_sweep_has_the_expected_outcome():
    """One of the slow cases, so that a quick run includes one."""
    (case,) = [c for c in select_cases(["sweep"]) if "quad of degree 1" in c.description]
    line, outcome = run_case(case)
    assert line.verdict == Verdict.EXPECTED, line.observed
    assert [level.amplitude for level in outcome.levels] == sorted(
        r.amplitude for r in outcome.levels
    )
    assert outcome.levels[0].amplitude == 1e-9
    assert outcome.levels[-1].amplitude == 25


def test_cases_cover_all_identifiers():
    assert stress.names(select_cases()) == [*(f"T{k}" for k in range(1, 24)), "sweep"]


def test_a_number_that_misses_its_reference_is_silently_wrong(monkeypatch):
    """The references are compared: another one makes the case silently wrong."""
    monkeypatch.setitem(stress.networks.REFERENCE_CORNER, 1e-2, ".900")
    (case,) = select_cases(["T21"])
    line, _ = run_case(case)
    assert line.verdict == Verdict.WRONG
    assert "not .900" in line.observed


# ------------------------------------------------------------------ the command


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    ("outcome", "status"),
    [
        (classify("well"), 0),
        (classify("no answer", failures=["it said so"]), 0),
        (replace(classify(""), verdict=Verdict.WRONG), 1),
    ],
)
def test_only_what_is_silently_wrong_ends_the_command_with_1(
    script, tmp_path, monkeypatch, outcome, status
):
    runs = (lambda auditor: outcome), (lambda auditor: classify("well"))
    found = [Case("T0", "a case", "nothing", run) for run in runs]
    monkeypatch.setattr(stress, "select_cases", lambda wanted: found)
    ended = script("stress", cwd=tmp_path)
    assert ended.status == status
    rows = table(tmp_path / "runs/stress/cases.csv")
    assert [row["verdict"] for row in rows] == [outcome.verdict, "as expected"]


def test_rows_are_there_before_the_next_case_begins(script, tmp_path, monkeypatch):
    def interrupted(auditor):
        raise KeyboardInterrupt

    found = [
        Case("T0", "done", "", lambda auditor: classify("well")),
        Case("T0", "interrupted", "", interrupted),
    ]
    monkeypatch.setattr(stress, "select_cases", lambda wanted: found)
    ended = script("stress", cwd=tmp_path)
    assert ended.status == 130
    assert [row["description"] for row in table(tmp_path / "runs/stress/cases.csv")] == ["done"]

"""The matrix: every case is as expected; the command ends with 1 where one is silently wrong."""

import csv
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from benchmarks import stress
from benchmarks.stress import Case, Verdict, matrix, perform
from benchmarks.stress.auditor import Auditor
from benchmarks.stress.case import classify
from benchmarks.stress.trained_run import Ladder, cases, hybrid, newton, simulated
from dpl.fem import solve
from dpl.models import FCNN
from dpl.training import MSE, Surrogate

LONG = {"T1", "T2", "T8", "ladder"}  # seconds each


def name_of(case: Case) -> str:
    return f"{case.name}, {case.what}"


def marked(case: Case):
    return pytest.param(case, marks=[pytest.mark.slow] if case.name in LONG else [])


@pytest.mark.parametrize("case", [*map(marked, matrix())], ids=[*map(name_of, matrix())])
def test_case_is_as_expected(case):
    line, _ = perform(case)
    assert line.verdict == Verdict.EXPECTED, line.happened
    assert not line.smallest <= 0


def test_a_ladder_is_as_expected():
    """One of the long ones, so that a quick run has one too."""
    (case,) = [c for c in matrix(["ladder"]) if "quad of degree 1" in c.what]
    line, outcome = perform(case)
    assert line.verdict == Verdict.EXPECTED, line.happened
    assert [rung.amplitude for rung in outcome.rungs] == sorted(r.amplitude for r in outcome.rungs)
    assert outcome.rungs[0].amplitude == 1e-9
    assert outcome.rungs[-1].amplitude == 25


def test_all_numbers_of_the_table_are_in_the_matrix():
    assert stress.names(matrix()) == [*(f"T{k}" for k in range(1, 24)), "ladder"]


def test_a_case_that_does_not_exist_is_an_error():
    with pytest.raises(ValueError, match="'T99' is none of T1, T2"):
        matrix(["T99"])


def test_a_number_that_is_off_is_seen(monkeypatch):
    """The references are compared: another one makes the case silently wrong."""
    monkeypatch.setitem(stress.networks.SCALED, 1e-2, ".900")
    (case,) = matrix(["T21"])
    line, _ = perform(case)
    assert line.verdict == Verdict.WRONG
    assert "not .900" in line.happened


# ------------------------------------------------------------------ the command


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_two_cases_from_the_command_line(script, tmp_path):
    ended = script("stress", "cases=[T12,T21]", cwd=tmp_path)
    assert ended.status == 0, ended.err
    assert "expected: an error with the numbers of the cells" in ended.out
    assert "happened: ValueError: 4 cells are inverted: 2, 3, 6, 7" in ended.out
    assert "2 cases in" in ended.out
    rows = table(tmp_path / "runs/stress/cases.csv")
    assert [row["case"] for row in rows] == ["T12", "T21"]
    assert {row["verdict"] for row in rows} == {"as expected"}
    numbers = table(tmp_path / "runs/stress/numbers.csv")
    assert ".818" in {row["reference"] for row in numbers}
    assert all(row["holds"] == "True" for row in numbers)


def test_ladders_are_drawn(script, tmp_path, monkeypatch):
    whole = matrix(["ladder"])
    (case,) = [c for c in whole if "triangle of degree 1" in c.what]
    monkeypatch.setattr(stress, "matrix", lambda wanted: [case])
    ended = script("stress", "folder=out", cwd=tmp_path)
    assert ended.status == 0, ended.err
    assert (tmp_path / "out/ladders.png").stat().st_size > 5000
    assert len(table(tmp_path / "out/ladders.csv")) == len(stress.loads.LADDER)


@pytest.mark.parametrize(
    ("outcome", "status"),
    [
        (classify("well"), 0),
        (classify("no answer", fails=["it said so"]), 0),
        (replace(classify(""), verdict=Verdict.WRONG), 1),
    ],
)
def test_only_what_is_silently_wrong_ends_the_command_with_1(
    script, tmp_path, monkeypatch, outcome, status
):
    first = Case("T0", "a liar", "nothing", lambda watch: outcome)
    second = Case("T0", "the next one", "nothing", lambda watch: classify("well"))
    monkeypatch.setattr(stress, "matrix", lambda wanted: [first, second])
    ended = script("stress", cwd=tmp_path)
    assert ended.status == status
    rows = table(tmp_path / "runs/stress/cases.csv")
    assert [row["verdict"] for row in rows] == [outcome.verdict, "as expected"]


def test_rows_are_there_before_the_next_case_begins(script, tmp_path, monkeypatch):
    def interrupted(watch):
        raise KeyboardInterrupt

    found = [
        Case("T0", "done", "", lambda watch: classify("well")),
        Case("T0", "interrupted", "", interrupted),
    ]
    monkeypatch.setattr(stress, "matrix", lambda wanted: found)
    ended = script("stress", cwd=tmp_path)
    assert ended.status == 130
    assert [row["what"] for row in table(tmp_path / "runs/stress/cases.csv")] == ["done"]


def test_unknown_cases_and_runs_are_refused_with_one_line(script, tmp_path):
    for argument, words in (("cases=[T99]", "cases: 'T99'"), ("run=runs/none", "run = runs/none")):
        ended = script("stress", argument, cwd=tmp_path)
        assert ended.status == 2
        assert ended.err.startswith(f"error: {words}")


# ------------------------------------------------------------------ a surrogate


@pytest.fixture(scope="module")
def ladder(scene) -> Ladder:
    """A ladder for an untrained network."""
    torch.manual_seed(0)
    surrogate = Surrogate(FCNN(scene, width=8), MSE(), scene)
    return Ladder(surrogate.eval(), 1, (1e-9, 1e-3, 1.0, 2.0, 10.0))


def test_loads_of_a_ladder_have_their_amplitudes(ladder, scene):
    for step in ladder.steps:
        amplitude, _ = scene.loads.project(step.load.force)
        assert amplitude.item() == pytest.approx(step.amplitude, rel=1e-6)


def test_an_untrained_surrogate_says_what_it_is(ladder):
    watch = Auditor()
    alone, exact = simulated(ladder, None, watch), simulated(ladder, 1e-6, watch)
    assert alone.verdict == Verdict.EXPECTED, alone.happened
    assert exact.verdict == Verdict.EXPECTED, exact.happened
    assert "an estimate" in alone.rungs[2].status
    assert "10 times the training's largest" in alone.rungs[-1].status
    assert alone.rungs[2].error > 0.1 > 1e-4 > exact.rungs[2].error
    for kind in (hybrid, newton):
        outcome = kind(ladder, watch)
        assert outcome.verdict == Verdict.EXPECTED, outcome.happened
    assert watch.lies == []
    assert watch.solves == 2 * len(ladder.steps)


LIES = {
    "it converged": {"converged": True},
    "its residual": {"residual": 1e-9},
    "nothing is inverted": {"volume_ratio": -1.0},
    "it is no estimate": {"summary": "in balance"},
    "it is in range": {"out_of_distribution": False},
}


@pytest.mark.parametrize("lie", LIES)
def test_a_simulator_that_says_what_is_not_so_is_seen(ladder, lie):
    real = ladder.asked

    def asked(step, tol):
        return replace(real(step, tol), **LIES[lie])

    liar = SimpleNamespace(steps=ladder.steps, scene=ladder.scene, asked=asked)
    assert simulated(liar, None, Auditor()).verdict == Verdict.WRONG


def test_a_surrogate_has_four_cases(ladder):
    found = cases(ladder.surrogate, count=1)
    assert [case.name for case in found] == ["run"] * 4
    assert solve(ladder.scene.solver, ladder.steps[0].load).converged.all()

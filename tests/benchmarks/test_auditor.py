"""Laws of the auditor: a false statement of a solver is recorded."""

from dataclasses import replace

import pytest
import torch

from benchmarks.stress import Case, Verdict, run_case
from benchmarks.stress.auditor import Auditor
from benchmarks.stress.case import classify, combine, expect_error
from benchmarks.stress.fixtures import as_load, column, end_traction
from benchmarks.stress.stability import SVK
from benchmarks.verification.report import Row
from dpl.fem import Newton, Status, solve


class ChangedSolver:
    """A solver that changes the last state of another one."""

    def __init__(self, newton, change):
        """Take the solver and the change."""
        self.newton, self.change = newton, change

    def iterate(self, load):
        """Yield the states."""
        *states, last = self.newton.iterate(load)
        yield from states
        yield self.change(last)


def violations_of(newton, load, change):
    auditor = Auditor()
    auditor.solve(ChangedSolver(newton, change), newton.problem, load, tol=newton.tol)
    return auditor.violations


@pytest.fixture(scope="module")
def bent_beam(scene):
    """A solver and a load that it solves."""
    return scene.solver, as_load(end_traction(scene.problem, 20.0))


def test_every_state_is_checked_and_a_true_solution_has_no_violations(bent_beam):
    newton, load = bent_beam
    auditor = Auditor()
    states = list(auditor.wrap(newton, newton.problem, newton.tol).iterate(load))
    assert auditor.states_checked == len(states)
    assert auditor.solves == 1
    volumes = [float(state.volume_ratio) for state in states if state.iterations]
    assert auditor.min_detF == pytest.approx(min(volumes), rel=1e-9)
    assert auditor.violations == []


def value(number):
    return torch.tensor([number], dtype=torch.float64)


FALSE = {  # words of the violation: what is changed in the last state of a true solution
    "accepted with min det F = -": lambda last, body: {
        "displacement": torch.where(body.free, -1.5 * body.points, 0.0)[None],
        "volume_ratio": value(0.9),
        "status": torch.tensor([int(Status.NOT_CONVERGED)]),
    },
    "an iterate was accepted with min det F": lambda last, body: {
        "displacement": torch.where(body.free, -1.5 * body.points, 0.0)[None],
        "volume_ratio": value(-0.5),
        "status": torch.tensor([int(Status.NOT_CONVERGED)]),
    },
    "reported was": lambda last, body: {"volume_ratio": 0.99 * last.volume_ratio},
    "residual is": lambda last, body: {"displacement": 0.999 * last.displacement},
    "reported: converged": lambda last, body: {  # supports have moved
        "displacement": last.displacement + 1e-6 * (~body.free).double()
    },
    "load factor 0.5 is no equilibrium": lambda last, body: {
        "status": torch.tensor([int(Status.NO_VALID_EQUILIBRIUM)]), "load_factor": value(0.5),
    },
}  # fmt: skip


@pytest.mark.parametrize("words", FALSE)
def test_a_false_statement_of_a_solver_is_recorded(words, scene, bent_beam):
    found = violations_of(
        *bent_beam, lambda last: last._replace(**FALSE[words](last, scene.problem))
    )
    assert any(words in violation for violation in found)


def test_an_inverted_start_is_not_an_accepted_iterate(scene, bent_beam):
    newton, _ = bent_beam
    guess = torch.where(scene.problem.free, -1.5 * scene.problem.points, 0.0)[None]
    auditor, (state, *_) = Auditor(), newton.iterate(bent_beam[1])
    auditor.check_iterate(
        newton.problem,
        state._replace(displacement=guess, volume_ratio=newton.problem.volume_ratio(guess)),
    )
    assert auditor.violations == []


@pytest.mark.parametrize("said", [0, 2])
def test_false_stability_is_recorded(said):
    problem, force = column(SVK, (10, 1, 1))
    honest = solve(Newton(problem), as_load(2.5 * force))
    assert honest.status.item() == Status.UNSTABLE
    found = violations_of(
        Newton(problem),
        as_load(2.5 * force),
        lambda last: last._replace(negative_pivots=torch.tensor([said])),
    )
    assert found == ([] if said else ["reported as stable; the tangent has 2 negative pivots"])


def test_a_violation_makes_a_case_silently_wrong_whatever_the_case_reports(scene, bent_beam):
    newton, load = bent_beam

    def run(auditor):
        changed = ChangedSolver(
            newton, lambda last: last._replace(displacement=0.999 * last.displacement)
        )
        auditor.solve(changed, newton.problem, load, tol=newton.tol)
        return classify("all is well")

    case = Case("T0", "a liar", "nothing", run)
    line, outcome = run_case(case)
    assert line.verdict == outcome.verdict == Verdict.WRONG
    assert "residual is" in line.observed
    good = replace(case, run=lambda auditor: classify("well"))
    assert run_case(good)[0].verdict == Verdict.EXPECTED
    line, _ = run_case(replace(case, run=lambda auditor: _raise(ArithmeticError("no\nanswer"))))
    assert (line.verdict, line.observed) == (Verdict.REPORTED, "ArithmeticError: no")


def test_numbers_that_miss_are_silently_wrong_and_reported_failures_are_not():
    good, bad = Row("x", "1.00", 1.001), Row("x", "1.00", 1.2)
    assert classify("", [good]).verdict == Verdict.EXPECTED
    assert classify("", [good], failures=["slow"]).verdict == Verdict.REPORTED
    wrong = classify("", [good, bad], failures=["slow"])
    assert wrong.verdict == Verdict.WRONG
    assert "x is 1.2 and not 1.00" in wrong.observed
    worst = combine([classify("fine", [good]), wrong])
    assert worst.verdict == Verdict.WRONG
    assert "fine" not in worst.observed
    assert len(worst.rows) == 3


def _raise(error):
    raise error


@pytest.mark.parametrize(
    ("action", "verdict"),
    [
        (lambda: _raise(ValueError("nu = 0.5 is out of range")), Verdict.EXPECTED),
        (lambda: _raise(ValueError("something else")), Verdict.REPORTED),
        (lambda: _raise(ValueError("nu = 0.5\nTraceback")), Verdict.REPORTED),
        (lambda: None, Verdict.WRONG),
    ],
)
def test_a_missing_error_is_silently_wrong(action, verdict):
    assert expect_error("nu", action, "nu = 0.5").verdict == verdict

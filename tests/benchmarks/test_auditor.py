"""Laws of the watch: what a solver says and is not so does not pass."""

from dataclasses import replace

import pytest
import torch

from benchmarks.stress import Case, Verdict, perform
from benchmarks.stress.auditor import Auditor
from benchmarks.stress.case import all_of, classify, refused
from benchmarks.stress.fixtures import column, load_of, pulled
from benchmarks.stress.stability import SVK
from benchmarks.verification.report import Row
from dpl.fem import Newton, Status, solve


class Liar:
    """A solver that changes what another one says in the end."""

    def __init__(self, newton, change):
        """Take the solver and the change."""
        self.newton, self.change = newton, change

    def iterate(self, load):
        """Yield the states."""
        *states, last = self.newton.iterate(load)
        yield from states
        yield self.change(last)


def lies_of(newton, load, change):
    watch = Auditor()
    watch.solve(Liar(newton, change), newton.problem, load, tol=newton.tol)
    return watch.lies


@pytest.fixture(scope="module")
def bent(scene):
    """A solver and a load that it answers."""
    return scene.solver, load_of(pulled(scene.problem, 20.0))


def folded(scene):
    """A displacement (1, N, 3) that inverts elements and moves nothing that is held."""
    return torch.where(scene.problem.free, -1.5 * scene.problem.points, 0.0)[None]


def test_an_honest_answer_has_no_lies(bent):
    assert lies_of(*bent, lambda last: last) == []


def test_every_state_is_seen(bent):
    newton, load = bent
    watch = Auditor()
    states = list(watch.over(newton, newton.problem, newton.tol).iterate(load))
    assert watch.iterates == len(states)
    assert watch.solves == 1
    volumes = [float(state.volume_ratio) for state in states if state.iterations]
    assert watch.smallest == pytest.approx(min(volumes), rel=1e-9)


def test_an_inverted_iterate_is_seen_whatever_is_said_of_it(scene, bent):
    for said in (0.9, -0.5):
        found = lies_of(
            *bent,
            lambda last, said=said: last._replace(
                displacement=folded(scene),
                volume_ratio=torch.tensor([said], dtype=torch.float64),
                status=torch.tensor([int(Status.NOT_CONVERGED)]),
            ),
        )
        assert any("accepted with min det F = -" in lie for lie in found)


def test_an_inverted_start_is_no_iterate(scene, bent):
    newton, _ = bent
    guess = folded(scene)
    watch, (state, *_) = Auditor(), newton.iterate(bent[1])
    watch.see(
        newton.problem,
        state._replace(displacement=guess, volume_ratio=newton.problem.volume_ratio(guess)),
    )
    assert watch.lies == []


def test_a_wrong_volume_ratio_is_seen(bent):
    found = lies_of(*bent, lambda last: last._replace(volume_ratio=0.99 * last.volume_ratio))
    assert any("said was" in lie for lie in found)


def test_false_convergence_is_seen(bent):
    found = lies_of(*bent, lambda last: last._replace(displacement=0.999 * last.displacement))
    assert any("residual is" in lie for lie in found)


def test_moved_supports_are_seen(scene, bent):
    moved = 1e-6 * (~scene.problem.free).double()
    found = lies_of(*bent, lambda last: last._replace(displacement=last.displacement + moved))
    assert any(lie.startswith("said: converged") for lie in found)


def test_a_part_of_the_load_that_has_no_answer_is_seen(bent):
    found = lies_of(
        *bent,
        lambda last: last._replace(
            status=torch.tensor([int(Status.NO_VALID_EQUILIBRIUM)]),
            load_factor=torch.tensor([0.5], dtype=torch.float64),
        ),
    )
    assert any("0.5 of the load is no part" in lie for lie in found)


@pytest.mark.parametrize("said", [0, 2])
def test_false_stability_is_seen(said):
    problem, force = column(SVK, (10, 1, 1))
    honest = solve(Newton(problem), load_of(2.5 * force))
    assert honest.status.item() == Status.UNSTABLE
    found = lies_of(
        Newton(problem),
        load_of(2.5 * force),
        lambda last: last._replace(negative_pivots=torch.tensor([said])),
    )
    assert found == ([] if said else ["said to be stable; the tangent has 2 negative pivots"])


def test_a_lie_makes_a_case_silently_wrong_whatever_the_case_says(scene, bent):
    newton, load = bent

    def run(watch):
        liar = Liar(newton, lambda last: last._replace(displacement=0.999 * last.displacement))
        watch.solve(liar, newton.problem, load, tol=newton.tol)
        return classify("all is well")

    case = Case("T0", "a liar", "nothing", run)
    line, outcome = perform(case)
    assert line.verdict == outcome.verdict == Verdict.WRONG
    assert "residual is" in line.happened
    assert perform(replace(case, run=lambda watch: classify("well")))[0].verdict == Verdict.EXPECTED


def test_what_a_case_raises_is_reported():
    def run(watch):
        raise ArithmeticError("no answer\nat all")

    line, _ = perform(Case("T0", "", "", run))
    assert line.verdict == Verdict.REPORTED
    assert line.happened == "ArithmeticError: no answer"


def test_numbers_that_miss_are_silently_wrong_and_failures_that_say_so_are_not():
    good, bad = Row("x", "1.00", 1.001), Row("x", "1.00", 1.2)
    assert classify("", [good]).verdict == Verdict.EXPECTED
    assert classify("", [good], fails=["slow"]).verdict == Verdict.REPORTED
    wrong = classify("", [good, bad], fails=["slow"])
    assert wrong.verdict == Verdict.WRONG
    assert "x is 1.2 and not 1.00" in wrong.happened
    worst = all_of([classify("fine", [good]), wrong])
    assert worst.verdict == Verdict.WRONG
    assert "fine" not in worst.happened
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
def test_an_error_that_does_not_come_is_silently_wrong(action, verdict):
    assert refused("nu", action, "nu = 0.5").verdict == verdict

"""Laws of the comparison of Newtons: textbook steps, honest counts, a row for each."""

import csv
import math

import pytest
import torch

from dpl import convergence
from dpl.convergence import PlainNewton, contestants, load_sets, measure
from dpl.fem.newton import Newton
from dpl.fem.solution import solve
from dpl.rows import write


@pytest.fixture(scope="module")
def loads(scene):
    return scene.loads.sample((0, 9), range(4))


@pytest.fixture(scope="module")
def networks(scene):
    """A network that knows the answer to a thousandth, and one that knows nothing."""
    near = lambda load: 1.001 * solve(scene.solver, load).displacement  # noqa: E731
    return {"near": near, "nan": lambda load: torch.full_like(load.force, torch.nan)}


def test_plain_newton_takes_whole_steps_until_it_balances(scene, loads):
    load = loads.singles()[0]
    states = list(PlainNewton(scene.solver).iterate(load))
    assert states[-1].converged
    assert [int(s.iterations) for s in states] == list(range(len(states)))
    assert torch.allclose(states[1].displacement[0], scene.linear.respond(load.force[0]), atol=1e-9)
    exact = solve(scene.solver, load).displacement
    assert torch.allclose(states[-1].displacement, exact, atol=1e-8)


def test_plain_newton_may_fail_and_says_so(scene, loads):
    load = loads.singles()[0]
    hard = load._replace(force=200 * load.force)
    end = solve(PlainNewton(scene.solver), hard)
    assert not end.converged
    assert int(end.iterations) <= 20


def test_plain_newton_is_quadratic_from_a_guess(scene, loads, networks):
    load = loads.singles()[0]
    states = list(PlainNewton(scene.solver).iterate(load, guess=networks["near"](load)))
    assert states[0].from_guess
    assert len(states) <= 4


def test_loads_are_those_of_the_test_set_and_larger_ones(scene):
    sets = load_sets(scene, 6, 2)
    assert {name: len(load.force) for name, load in sets.items()} == {
        "in range": 6, "twice": 6, "3 times": 2, "5 times": 2,
    }  # fmt: skip
    assert torch.equal(sets["in range"].force, scene.loads.sample((0, 2), range(6)).force)
    drawn = scene.loads.sample((0, 4), range(6)).force
    factors = sets["twice"].force.flatten(1).norm(dim=1) / drawn.flatten(1).norm(dim=1)
    assert torch.allclose(factors, torch.linspace(1, 2, 6).double())
    assert set(load_sets(scene, 6, 0)) == {"in range", "twice"}


@pytest.mark.parametrize("tol", [1e-3, 1e-8])
def test_each_solver_has_a_row(scene, loads, networks, tol):
    solvers = contestants(scene, networks, tol)
    ticks = []
    rows, times = measure(solvers, "in range", loads, tol, lambda: ticks.append(1))
    assert len(ticks) == 4
    assert [(row.solver, row.network) for row in rows] == list(solvers)
    by = {(row.solver, row.network): row for row in rows}
    reference = by[convergence.REFERENCE, ""]
    assert reference.ratio == 1.0
    assert reference.picked is None
    best, useless = by["hybrid, best rule", "near"], by["hybrid, best rule", "nan"]
    assert (best.picked, useless.picked) == (100, 0)
    assert best.iterations < reference.iterations
    assert best.apart < 10 * tol
    for key, row in by.items():
        assert row.converged == 100, key
        assert (times[key].isfinite()).all()


def test_what_does_not_converge_has_no_iterations_and_no_time(scene, loads, networks):
    hard = loads._replace(force=1e5 * loads.force)
    solver = Newton(scene.problem, smallest_step=0.9, max_iter=2)
    rows, times = measure({(convergence.REFERENCE, ""): solver}, "in range", hard, 1e-8)
    assert rows[0].converged == 0
    assert rows[0].iterations is None
    assert times[convergence.REFERENCE, ""].isinf().all()


def test_rows_and_figure_are_written(scene, loads, networks, tmp_path):
    rows, times = measure(contestants(scene, networks, 1e-3), "in range", loads, 1e-3)
    write(convergence.paper() + rows, tmp_path / "a.csv")
    convergence.draw({(1e-3, *key): each for key, each in times.items()}, tmp_path / "a.png")
    written = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert len(written) == 2 + len(rows)
    assert written[1]["picked"] == "66"
    assert written[0]["tol"] == ""
    assert (tmp_path / "a.png").stat().st_size > 10_000
    assert math.isnan(convergence.paper()[0].tol)


def test_the_script_measures_the_runs_of_a_folder(script, tiny_training, tmp_path):
    ended = script("train", *tiny_training, "trainer.max_epochs=1", "run=runs/e/a", cwd=tmp_path)
    assert ended.status == 0, ended.err[-2000:]
    few = ["run=runs/e", "tols=[1e-3,1e-6,1e-8]", "count=2", "far=1"]
    ended = script("convergence", *few, cwd=tmp_path)
    assert ended.status == 0, ended.err[-2000:]
    written = list(csv.DictReader((tmp_path / "results" / "hybrid_newton.csv").open()))
    assert len(written) == 2 + (3 * 2 + 2) * 8
    assert (tmp_path / "results" / "hybrid_newton.png").is_file()
    refused = script("convergence", "run=runs/none", cwd=tmp_path)
    assert refused.status == 2
    assert "holds no runs" in refused.err

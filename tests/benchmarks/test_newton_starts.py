"""Comparison of Newton solvers: the textbook method, counts, summaries."""

import math
from dataclasses import replace

import pytest
import torch

from benchmarks import newton_starts
from benchmarks.newton_starts import Trial, limited, load_sets, measure, solvers_of, summary
from benchmarks.plain_newton import PlainNewton
from dpl.fem import Newton, solve


@pytest.fixture(scope="module")
def loads(scene):
    return scene.loads.sample((0, 9), range(4))


@pytest.fixture(scope="module")
def networks(scene):
    """A network with an error of 1e-3, and one with a random prediction."""
    near = lambda load: 1.001 * solve(scene.solver, load).displacement  # noqa: E731
    return {"near": near, "nan": lambda load: torch.full_like(load.force, torch.nan)}


def test_plain_newton_takes_full_steps_until_it_converges(scene, loads):
    load = loads.unbatch()[0]
    states = list(PlainNewton(scene.solver).iterate(load))
    assert states[-1].converged
    assert [int(s.iterations) for s in states] == list(range(len(states)))
    assert torch.allclose(states[1].displacement[0], scene.linear.solve(load.force[0]), atol=1e-9)
    exact = solve(scene.solver, load).displacement
    assert torch.allclose(states[-1].displacement, exact, atol=1e-8)


def test_plain_newton_reports_divergence(scene, loads):
    load = loads.unbatch()[0]
    hard = load._replace(force=200 * load.force)
    end = solve(PlainNewton(scene.solver), hard)
    assert not end.converged
    assert int(end.iterations) <= 20


def test_plain_newton_needs_an_iteration(scene):
    with pytest.raises(ValueError, match="max_iter = 0 must be 1 or more"):
        PlainNewton(scene.solver, max_iter=0)


def test_plain_newton_is_quadratic_from_a_guess(scene, loads, networks):
    load = loads.unbatch()[0]
    states = list(PlainNewton(scene.solver).iterate(load, guess=networks["near"](load)))
    assert states[0].from_guess
    assert len(states) <= 4


def test_loads_are_those_of_the_test_set_and_larger_ones(scene):
    sets = load_sets(scene, 6)
    assert list(sets) == ["in range", "twice"]
    assert torch.equal(sets["in range"].force, scene.loads.sample((0, 2), range(6)).force)
    drawn = scene.loads.sample((0, 4), range(6)).force
    factors = sets["twice"].force.flatten(1).norm(dim=1) / drawn.flatten(1).norm(dim=1)
    assert torch.allclose(factors, torch.linspace(1, 2, 6).double())
    assert list(load_sets(scene, 6, twice=False)) == ["in range"]


@pytest.mark.parametrize("tol", [1e-3, 1e-8])
def test_each_solver_has_a_summary(scene, loads, networks, tol):
    solvers = solvers_of(scene, networks, tol)
    ticks = []
    trials = measure(solvers, "in range", loads, tol, lambda: ticks.append(1))
    assert len(ticks) == 4
    assert len(trials) == 4 * len(solvers)
    rows = [row for row in summary(trials) if row.loads == "in range"]
    assert [(row.solver, row.network) for row in rows] == list(solvers)
    by = {(row.solver, row.network): row for row in rows}
    reference = by[newton_starts.REFERENCE, ""]
    assert reference.time_ratio == 1.0
    assert reference.used_prediction_pct is None
    best, useless = (by["hybrid, natural monotonicity", name] for name in ("near", "nan"))
    assert (best.used_prediction_pct, useless.used_prediction_pct) == (100, 0)
    assert best.iterations < reference.iterations
    assert best.deviation < 10 * tol
    assert all(row.converged == 100 for row in rows)
    assert all(0 < trial.ms < math.inf for trial in trials)


def trial(solver, number, converged, ms, iterations=3, deviation=0.0):
    network = "" if solver == newton_starts.REFERENCE else "net"
    return Trial(
        solver, network, "in range", 1e-6, number, converged, True, iterations, 1, ms, deviation
    )


def test_summaries_count_converged_loads_and_compare_where_both_converged():
    """Of four loads, robust Newton and the hybrid converge for three each, both for two."""
    trials = [
        trial(newton_starts.REFERENCE, k, converged, ms)
        for k, (converged, ms) in enumerate([(True, 10), (True, 30), (True, 99), (False, 999)])
    ]
    hybrid = [(True, 5, 1, 1e-7), (True, 15, 2, 1e-9), (False, 7, 40, 0.5), (True, 8, 6, 0.3)]
    trials += [
        trial("hybrid", k, converged, ms, iterations, apart)
        for k, (converged, ms, iterations, apart) in enumerate(hybrid)
    ]
    twice = [replace(each, loads="twice", ms=3 * each.ms) for each in trials]
    rows = {(r.loads, r.solver): r for r in summary([*trials, *twice])}
    assert len(rows) == 6
    both = rows["in range and twice", "hybrid"]
    assert (both.count, both.converged, both.time_ratio, both.ms) == (8, 75, 20 / 40, 15)
    reference, row = rows["in range", newton_starts.REFERENCE], rows["in range", "hybrid"]
    known = reference.converged, reference.used_prediction_pct, reference.time_ratio
    assert known == (75, None, 1)
    known = row.converged, row.used_prediction_pct, row.iterations, row.max_iterations
    assert known == (75, 100, 3, 6)
    assert (row.ms, row.time_ratio, row.deviation) == (8, 20 / 40, 1e-7)


def test_a_limit_counts_loads_as_if_plain_newton_had_stopped_there(scene, loads, networks):
    names = ["plain Newton", "hybrid, paper's rule"]
    trials = measure(solvers_of(scene, networks, 1e-8, names=names), "in range", loads, 1e-8)
    least = min(t.iterations for t in trials if t.solver == "plain Newton")
    found = [t for t in limited(trials, least) if t.solver.startswith("plain Newton")]
    stopped = solve(PlainNewton(scene.solver, max_iter=least), loads)
    assert [t.converged for t in found] == stopped.converged.tolist()
    assert [t.iterations for t in found] == stopped.iterations.tolist()
    assert {t.solver for t in limited(trials, 3)} == {f"{n}, at most 3 iterations" for n in names}


def test_solvers_are_chosen_by_name(scene, networks):
    found = solvers_of(scene, networks, 1e-3, names=["hybrid, paper's rule"])
    paper = [("hybrid, paper's rule", name) for name in networks]
    assert list(found) == [(newton_starts.REFERENCE, ""), *paper]
    with pytest.raises(ValueError, match=r"\['fast'\] must be names of solvers: plain Newton, "):
        solvers_of(scene, networks, 1e-3, names=["fast"])


def test_a_solver_that_never_converges_has_no_iterations_and_no_time(scene, loads):
    hard = loads._replace(force=1e5 * loads.force)
    solver = Newton(scene.problem, min_load_step=0.9, max_iter=2)
    trials = measure({(newton_starts.REFERENCE, ""): solver}, "in range", hard, 1e-8)
    (row,) = summary(trials)
    assert row.loads == "in range"
    assert row.converged == 0
    assert row.iterations is row.ms is row.time_ratio is None


def test_both_sets_of_the_paper_are_combined_where_there_are_both(scene, loads):
    trials = measure(solvers_of(scene, {}, 1e-3, names=[]), "in range", loads, 1e-3)
    twice = [replace(trial, loads="twice") for trial in trials]
    assert [row.loads for row in summary(trials)] == ["in range"]
    rows = {row.loads: row.count for row in summary([*trials, *twice])}
    count = len(loads.force)
    assert rows == {newton_starts.BOTH: 2 * count, "in range": count, "twice": count}


def test_larger_loads_need_more_iterations_of_plain_newton_and_have_solutions(scene_of):
    """Robust Newton solves the loads of experiment hybrid_newton_hard with few iterations."""
    means = {}
    for name in ("hybrid_newton", "hybrid_newton_hard"):
        scene = scene_of(f"experiment={name}", "mesh.nodes=[12,5,5]")
        solvers = solvers_of(scene, {}, 1e-6, names=["plain Newton"])
        trials = measure(solvers, "in range", load_sets(scene, 10)["in range"], 1e-6)
        rows = {row.solver: row for row in summary(trials)[:2]}
        assert rows[newton_starts.REFERENCE].converged == 100
        means[name] = [rows[key].iterations for key in ("plain Newton", newton_starts.REFERENCE)]
    (usual, _), (plain, robust) = means.values()
    assert plain > 1.2 * usual
    assert plain > 1.2 * robust

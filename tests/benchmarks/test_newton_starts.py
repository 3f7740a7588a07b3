"""Comparison of Newton solvers: the textbook method, counts, summaries."""

import math
from dataclasses import replace

import pytest
import torch

from benchmarks import convergence
from benchmarks.convergence import Trial, limited, measure, solvers_of, summary
from benchmarks.plain_newton import PlainNewton
from dpl.fem import solve


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


def test_plain_newton_is_quadratic_from_a_guess(scene, loads, networks):
    load = loads.unbatch()[0]
    states = list(PlainNewton(scene.solver).iterate(load, guess=networks["near"](load)))
    assert states[0].from_guess
    assert len(states) <= 4


def test_each_solver_has_a_summary(scene, loads, networks):
    tol = 1e-8
    solvers = solvers_of(scene, networks, tol)
    ticks = []
    trials = measure(solvers, "in range", loads, tol, lambda: ticks.append(1))
    assert len(ticks) == 4
    assert len(trials) == 4 * len(solvers)
    rows = [row for row in summary(trials) if row.loads == "in range"]
    assert [(row.solver, row.network) for row in rows] == list(solvers)
    by = {(row.solver, row.network): row for row in rows}
    reference = by[convergence.REFERENCE, ""]
    assert reference.time_ratio == 1.0
    assert reference.used_prediction_pct is None
    best, useless = (by["hybrid, natural monotonicity", name] for name in ("near", "nan"))
    assert (best.used_prediction_pct, useless.used_prediction_pct) == (100, 0)
    assert best.iterations < reference.iterations
    assert best.deviation < 10 * tol
    assert all(row.converged == 100 for row in rows)
    assert all(0 < trial.ms < math.inf for trial in trials)


def trial(solver, number, converged, ms, iterations=3, deviation=0.0):
    network = "" if solver == convergence.REFERENCE else "net"
    return Trial(
        solver, network, "in range", 1e-6, number, converged, True, iterations, 1, ms, deviation
    )


def test_summaries_count_converged_loads_and_compare_where_both_converged():
    """Of four loads, robust Newton and the hybrid converge for three each, both for two."""
    trials = [
        trial(convergence.REFERENCE, k, converged, ms)
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
    reference, row = rows["in range", convergence.REFERENCE], rows["in range", "hybrid"]
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

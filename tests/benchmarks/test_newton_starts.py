"""Comparison of Newton solvers: the textbook method, counts, summaries."""

import csv
import math
import os
import time
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from matplotlib.figure import Figure

from benchmarks import newton_figure, newton_starts
from benchmarks.commands import convergence
from benchmarks.newton_starts import (
    Trial,
    limited,
    load_sets,
    measure,
    solvers_of,
    summary,
)
from benchmarks.plain_newton import PlainNewton
from benchmarks.tables import read
from dpl.evaluation.tables import write
from dpl.fem import Newton, solve
from dpl.inference import Hybrid


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


def test_a_small_step_ends_plain_newton_and_does_not_make_a_state_converged(scene, loads):
    """The iterations are those without `step_tol` up to the first step whose norm is below it."""
    load = loads.unbatch()[0]
    states = list(PlainNewton(scene.solver).iterate(load))
    steps = [float((b.displacement - a.displacement).norm()) for a, b in pairwise(states)]
    assert len(steps) > 3
    tol = 1.01 * steps[2]
    ended = list(PlainNewton(scene.solver, step_tol=tol).iterate(load))
    first = next(k for k, step in enumerate(steps) if step < tol)
    assert len(ended) == first + 2
    assert not ended[-1].converged
    assert torch.equal(ended[-1].displacement, states[first + 1].displacement)


def test_the_paper_s_hybrid_ends_with_a_small_step_too(scene, loads, networks):
    load = loads.unbatch()[0]
    solver = PlainNewton(scene.solver, step_tol=1e3)
    end = solve(Hybrid(networks["near"], solver, "paper"), load)
    assert (bool(end.from_guess), int(end.iterations), bool(end.converged)) == (True, 2, False)


@pytest.mark.parametrize("options", [{"max_iter": 0}, {"step_tol": -1.0}, {"step_tol": math.nan}])
def test_options_of_plain_newton_out_of_range_are_refused(scene, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        PlainNewton(scene.solver, **options)


def test_plain_newton_is_quadratic_from_a_guess(scene, loads, networks):
    load = loads.unbatch()[0]
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
    assert set(load_sets(scene, 6, 0, twice=False)) == {"in range"}


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
    best, useless = (
        by["hybrid, natural monotonicity", "near"],
        by["hybrid, natural monotonicity", "nan"],
    )
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
    assert (reference.converged, reference.used_prediction_pct, reference.time_ratio) == (
        75,
        None,
        1,
    )
    assert (row.converged, row.used_prediction_pct, row.iterations, row.max_iterations) == (
        75,
        100,
        3,
        6,
    )
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


def test_trials_summaries_and_figure_are_written(scene, loads, networks, tmp_path):
    trials = measure(solvers_of(scene, networks, 1e-3), "in range", loads, 1e-3)
    write(trials, tmp_path / "trials.csv")
    again = read(Trial, tmp_path / "trials.csv")
    assert [replace(t, ms=0.0, deviation=0.0) for t in again] == [
        replace(t, ms=0.0, deviation=0.0) for t in trials
    ]
    assert [t.ms for t in again] == pytest.approx([t.ms for t in trials], rel=1e-3)
    write(newton_starts.PAPER + summary(trials), tmp_path / "a.csv")
    newton_figure.draw(trials, tmp_path / "a.png", limit=5)
    written = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert len(written) == 2 + 4 + 2 * 4
    assert written[1]["used_prediction_pct"] == "66"
    assert written[0]["tol"] == ""
    assert (tmp_path / "a.png").stat().st_size > 10_000
    with pytest.raises(ValueError, match=r"a\.csv must have the columns solver, network"):
        read(Trial, tmp_path / "a.csv")


def test_larger_loads_need_more_iterations_of_plain_newton_and_have_solutions(scene_of):
    """Robust Newton solves the loads of experiment hybrid_newton_hard with few iterations."""
    means = {}
    for name in ("hybrid_newton", "hybrid_newton_hard"):
        scene = scene_of(f"experiment={name}", "mesh.nodes=[12,5,5]")
        solvers = solvers_of(scene, {}, 1e-6, names=["plain Newton"])
        trials = measure(solvers, "in range", load_sets(scene, 10, 0)["in range"], 1e-6)
        rows = {row.solver: row for row in summary(trials)[:2]}
        assert rows[newton_starts.REFERENCE].converged == 100
        means[name] = [rows[key].iterations for key in ("plain Newton", newton_starts.REFERENCE)]
    (usual, _), (plain, robust) = means.values()
    assert plain > 1.2 * usual
    assert plain > 1.2 * robust


def test_lines_are_labelled_and_labels_do_not_overlap(monkeypatch, tmp_path):
    """Each network has a panel over iterations and one over time, with four lines."""
    kept = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: kept.append(self))
    solvers = [("plain Newton", ""), (newton_starts.REFERENCE, "")]
    for network in ("a", "b"):
        solvers += [("hybrid, paper's rule", network), ("hybrid, natural monotonicity", network)]
    trials = [
        Trial(*solver, "in range", 1e-6, k, k != 3, True, 3 + k, 1, 10.0 + k, 0.0)
        for solver in solvers
        for k in range(4)
    ]
    newton_figure.draw(trials, tmp_path / "a.png")
    (figure,) = kept
    figure.draw_without_rendering()
    assert len(figure.axes) == 4
    for ax in figure.axes:
        labels = {text.get_text(): text.get_window_extent() for text in ax.texts}
        assert set(labels) == {"plain Newton", "robust Newton", "paper's hybrid", "our hybrid"}
        assert sum(a.overlaps(b) for a in labels.values() for b in labels.values()) == len(labels)
        assert len(ax.lines) == 4
        for line in ax.lines:
            assert list(line.get_ydata()) == [0, 25, 50, 75, 75]


@pytest.fixture
def resumed(compose, scene, monkeypatch):
    """Measures tasks as the command does; returns trials, and sets of loads that were measured."""
    measured = []

    def counted(solvers, name, *rest, **options):
        measured.append(name)
        return measure(solvers, name, *rest, **options)

    monkeypatch.setattr(newton_starts, "measure", counted)

    def resumed(*overrides, networks=()):
        measured.clear()
        few = ["run=e", "tols=[1e-3,1e-6]", "count=2", "n_far_loads=1", "twice=false"]
        cfg = compose(*few, "solvers=[plain Newton]", *overrides, command="convergence")
        return convergence.measure(cfg, scene, dict(networks)), list(measured)

    return resumed


def test_only_measurements_with_the_same_options_are_reused(resumed):
    near, far = ["in range"] * 2, ["3 times", "5 times"]
    first, measured = resumed()
    assert measured == near + far
    assert len(first) == 2 * (2 * 2 + 2)
    assert resumed()[1] == []
    stopped, measured = resumed("step_tol=1e3")
    assert measured == near + far
    assert {t.iterations for t in stopped if t.solver == "plain Newton"} == {1}
    assert resumed("max_far_iterations=7")[1] == far
    again, measured = resumed()
    assert measured == []
    assert [replace(t, ms=0, deviation=0) for t in again] == [
        replace(t, ms=0, deviation=0) for t in first
    ]


def test_tolerances_that_are_not_requested_are_left_out_and_kept_in_the_file(resumed):
    resumed("n_far_loads=0")
    one, measured = resumed("n_far_loads=0", "tols=[1e-6]")
    assert measured == []
    assert {trial.tol for trial in one} == {1e-6}
    assert resumed("n_far_loads=0", "tols=[1e-6,1e-6,1e-4]")[1] == ["in range"]
    both, measured = resumed("n_far_loads=0")
    assert measured == []
    assert len(summary(both)) == 2 * 2


def test_measurements_older_than_a_network_in_the_file_are_repeated(resumed, networks, tmp_path):
    near = {"near": networks["near"]}
    hybrid = 'solvers=[plain Newton,"hybrid, paper\'s rule"]'
    assert len(resumed(hybrid, networks=near)[1]) == 4
    weights = tmp_path / "e" / "near" / "checkpoints" / "best.safetensors"
    weights.parent.mkdir(parents=True)
    weights.touch()
    os.utime(weights, (time.time() + 100,) * 2)
    assert len(resumed("tols=[1e-3]", "n_far_loads=0")[1]) == 1
    assert {trial.network for trial in read(Trial, tmp_path / "e" / "hybrid_newton.csv")} == {""}


def test_the_script_measures_the_runs_of_a_folder_and_resumes(script, trained, tmp_path):
    few = ["run=runs/tiny", "networks=[fcnn]", "name=whole", f"folder={tmp_path}"]
    few += ["tols=[1e-3,1e-6,1e-8]", "count=2", "n_far_loads=1"]
    ended = script("convergence", *few, cwd=trained)
    assert ended.status == 0, ended.err[-2000:]
    results, raw = tmp_path, trained / "runs/tiny/whole.csv"
    whole = list(csv.DictReader((results / "whole.csv").open()))
    assert len(whole) == 2 + (3 * 3 + 2) * 8
    assert (results / "whole.png").is_file()
    lines = raw.read_text().splitlines(keepends=True)
    assert len(lines) == 1 + (3 * 2 * 2 + 2) * 8
    raw.write_text("".join(lines[: 1 + 3 * 16 + 5]))  # three sets, and one that was interrupted
    again = script("convergence", *few, cwd=trained)
    assert again.status == 0, again.err[-2000:]
    kept = raw.read_text().splitlines(keepends=True)
    assert kept[: 1 + 3 * 16] == lines[: 1 + 3 * 16]
    assert len(kept) == len(lines)
    assert len(list(csv.DictReader((results / "whole.csv").open()))) == len(whole)
    raw.write_text("a,b\n")
    refused = script("convergence", *few, cwd=trained)
    assert refused.status == 2
    assert "must have the columns" in refused.err

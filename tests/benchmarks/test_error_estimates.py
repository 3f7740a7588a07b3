"""Laws of the calibration: estimates are those of the simulator, quantiles those of the ratios."""

import csv
import math
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest
import torch

import dpl.inference.simulator as simulator_module
from benchmarks import error_estimates
from benchmarks.error_estimates import Estimate, measured, summarised
from dpl import Sample
from dpl.fem import SubspaceNewton, solve
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate

TINY = ["bodies=[beam]", "train=8", "val=2", "test=3", "epochs=1"]


@pytest.fixture(scope="module")
def samples(scene):
    load = scene.loads.sample((0, 9), range(4))
    return Sample(load.force, solve(scene.solver, load).displacement, load.young)


@pytest.fixture(scope="module")
def newton(scene):
    """Newton's method in three modes, which knows its error outside of them."""
    vectors = torch.linalg.qr(scene.loads.eigenmodes.vectors[..., :3].flatten(0, 1)).Q
    vectors = vectors.reshape(*scene.problem.shape, 3) * scene.problem.free[..., None]
    return SubspaceNewton(scene.problem, vectors, outside_error=2e-3)


@pytest.mark.parametrize("factor", [1.0, 2.0])
@pytest.mark.parametrize("known", [True, False])
def test_estimates_are_those_of_the_simulator(scene, samples, newton, factor, known, monkeypatch):
    load = samples.load._replace(force=factor * samples.force)
    loads = Sample(load.force, solve(scene.solver, load).displacement, load.young)
    predict = lambda load: 0.9 * solve(scene.solver, load).displacement  # noqa: E731
    surrogate = Surrogate(FCNN(scene, width=4), MSE(), scene)
    surrogate.predict = predict
    solver = newton if known else replace(newton, outside_error=0.0)
    si = scene.si_inputs(load)
    further = Simulator(surrogate, newton=solver)(**si)  # corrected outside of the modes, too
    monkeypatch.setattr(simulator_module, "SUFFICIENT", math.inf)  # steps in the modes only
    found = list(measured(scene, loads, predict, solver, stepped=True))
    answer = Simulator(surrogate, newton=solver)(**si)
    assert [one.reported for one in found] == pytest.approx(answer.error.tolist(), rel=1e-6)
    assert (further.error <= answer.error * (1 + 1e-6)).all()
    u = answer.displacement / scene.length
    errors = (u - loads.displacement).flatten(1).norm(dim=1)
    errors = errors / loads.displacement.flatten(1).norm(dim=1)
    assert [one.error for one in found] == pytest.approx(errors.tolist(), rel=1e-6)
    plain = list(measured(scene, loads, predict, None))
    assert [one.error for one in plain] == pytest.approx([0.1] * 4)
    assert all(math.isnan(one.modes) and one.reported == one.corotational for one in plain)


def test_quantiles_are_those_of_finite_ratios_of_each_group():
    ratios = np.linspace(1.0, 3.0, 21)
    group = [Estimate("a", "b", "c", 0.1, 0.1 * r, math.nan, 0.2) for r in ratios]
    lost = Estimate("a", "b", "c", 0.1, math.inf, math.nan, math.inf)
    other = Estimate("a", "d", "c", 0.5, 0.5, 1.0, 1.0)
    first, second = summarised([*group, lost, other])
    assert (first.count, first.unknown, second.count, second.unknown) == (22, 1, 1, 0)
    assert first.corotational_p5 == pytest.approx(1.1)
    assert first.corotational_median == pytest.approx(2.0)
    assert first.corotational_p95 == pytest.approx(2.9)
    assert first.reported_median == pytest.approx(2.0)
    assert math.isnan(first.modes_median)
    assert second.modes_p5 == second.modes_p95 == 2.0


def test_the_command_writes_rows_and_a_figure_and_prints_a_table(script, tmp_path):
    ended = script("error_estimates", *TINY, "folder=out", cwd=tmp_path)
    assert ended.status == 0, ended.err
    table = ended.out[ended.out.rindex("C 5") :].splitlines()
    assert max(len(line.rstrip()) for line in table) <= 100
    assert "…" not in ended.out
    assert "beam: estimate" in ended.out
    with (tmp_path / "out/error_estimates.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = [row["prediction"] for row in rows if row["loads"] == error_estimates.IN_RANGE]
    assert names == ["linear", "fcnn", "pod", "pod + steps", "unrolled", "unrolled + steps"]
    assert {row["loads"] for row in rows} == {error_estimates.IN_RANGE, error_estimates.TWICE}
    with (tmp_path / "out/error_estimates_loads.csv").open(newline="") as file:
        single = list(csv.DictReader(file))
    assert len(single) == sum(int(row["count"]) for row in rows)
    assert all(float(one["error"]) > 0 for one in single)
    pixels = matplotlib.image.imread(tmp_path / "out/error_estimates.png")
    assert np.ptp(pixels[..., :3]) > 0.5


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("bodies=[beam,table]", "must be some of beam, propeller, bracket, plate"),
        ("bodies=[]", "must be some of"),
        ("epochs=0", "epochs = 0"),
    ],
)
def test_invalid_input_is_refused_before_loads_are_solved(script, tmp_path, override, message):
    ended = script("error_estimates", *TINY, override, "folder=out", cwd=tmp_path)
    assert ended.status == 2
    assert message in ended.err
    assert not (tmp_path / "out").exists()


def test_the_bodies_are_what_their_names_say():
    scene = error_estimates.bracket()
    points = scene.problem.points
    assert not ((points[:, 0] > 0.4) & (points[:, 1] > 0.4)).any(), "the corner is cut out"
    assert scene.problem.material.poisson == 0.45
    sides = error_estimates.plate().problem.points
    assert (sides.amax(0) - sides.amin(0)).tolist() == pytest.approx([1.0, 0.5, 0.02])


def test_trained_runs_are_compared_in_place_of_bodies(script, tiny_training, tmp_path):
    short = ["model=fcnn", *tiny_training, "trainer.max_epochs=1", "logger=none"]
    assert script("train", *short, "run=runs/mine/one", cwd=tmp_path).status == 0
    ended = script("error_estimates", "run=runs/mine", "name=ours", "test=3", cwd=tmp_path)
    assert ended.status == 0, ended.err
    with (tmp_path / "runs/error_estimates/ours.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {(row["body"], row["prediction"]) for row in rows} == {
        ("mine", "linear"),
        ("mine", "one"),
    }
    assert {row["count"] for row in rows} == {"3"}

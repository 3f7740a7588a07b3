"""The benchmark of local loads measures single forces and small patches with their true errors."""

import pytest
import torch

from benchmarks import local_loads
from benchmarks.local_loads import LocalLoads
from dpl import Sample
from dpl.evaluation.tables import read
from dpl.fem import solve
from dpl.models import Unrolled
from dpl.training import MSE, Surrogate


@pytest.fixture(scope="module")
def surrogate(scene):
    load = scene.loads.sample(0, range(20))
    states = solve(scene.solver, load).displacement
    samples = Sample(load.force, states, load.young, load.parameters)
    net = Unrolled(scene, rank=20, cells=8, stages=1)
    net.fit(samples, samples)
    return Surrogate(net, MSE(), scene).eval()


def test_point_forces_act_on_one_node_and_patches_on_few(scene):
    kinds = list(local_loads.kinds(scene, 5))
    assert [name for name, *_ in kinds] == [local_loads.RUN, *2 * list(local_loads.FAMILIES)]
    for name, _, load in kinds[1:]:
        nodes = load.force.any(dim=2).sum(dim=1)
        assert (nodes == 1).all() if name == "point force" else (nodes <= 9).all()


def test_the_rows_have_the_errors_of_the_surrogate(surrogate, monkeypatch):
    monkeypatch.setattr(local_loads, "missing_packages", lambda: ["onnx"])
    rows = list(local_loads.measure(surrogate, 4))
    assert all(row.count == 4 and row.onnx_p50 is None for row in rows)
    assert all(0 < row.linear_p50 <= row.linear_p99 < 1e-5 for row in rows)
    scene = surrogate.scene
    load = scene.loads.sample(local_loads.STREAM, range(4))
    exact = solve(scene.newton, load).displacement
    with torch.no_grad():
        wrong = (surrogate.predict(load) - exact).flatten(1).norm(dim=1)
        errors = wrong / exact.flatten(1).norm(dim=1)
    assert rows[0].error_p50 == pytest.approx(float(errors.quantile(0.5)), rel=1e-4)
    small = [row for row in rows if row.deflection == min(local_loads.DEFLECTIONS)]
    assert all(row.error_p99 < 1e-2 for row in small)


def test_the_command_writes_a_row_for_each_kind(script, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(local_loads, "missing_packages", lambda: ["onnx"])
    few = ["data.train=12", "data.val=4", "data.test=2", "data.workers=0"]
    model = ["model=unrolled", "model.rank=12", "model.cells=8", "model.stages=1"]
    trained = script("train", *tiny, *few, *model, "run=runs/a", cwd=tmp_path)
    assert trained.status == 0, trained.err
    options = "cases=[local]", "run=runs/a", "count=2", "repeats=1"
    ended = script("benchmark", *options, cwd=tmp_path)
    assert ended.status == 0, ended.err
    rows = read(LocalLoads, tmp_path / "runs/benchmark/local_loads_a.csv")
    assert len(rows) == 5
    assert "point force, 0.001 L" in ended.out
    assert [r.count for r in rows if (r.loads, r.deflection) == ("point force", 1e-3)] == [2]


def test_a_run_of_unrolled_has_to_be_named(script, tiny_training, tmp_path):
    ended = script("benchmark", "cases=[local]", cwd=tmp_path)
    assert ended.status == 2
    assert "error: run = null must name the trained run" in ended.err
    trained = script("train", *tiny_training, "trainer.max_epochs=1", "run=runs/a", cwd=tmp_path)
    assert trained.status == 0, trained.err
    ended = script("benchmark", "cases=[local]", "run=runs/a", cwd=tmp_path)
    assert "error: run = runs/a must be a run of model=unrolled" in ended.err

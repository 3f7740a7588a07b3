"""The benchmark of local loads measures single forces and small patches with their true errors."""

import pytest
import torch

from benchmarks import local_loads
from dpl import Sample
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

"""The benchmark of a trained run times the calls that it names."""

import pytest
import torch

from benchmarks import run_latency
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate


@pytest.fixture
def simulator(scene):
    torch.manual_seed(0)
    return Simulator(Surrogate(FCNN(scene, width=8), MSE(), scene).eval())


def test_every_call_is_timed_with_every_load(simulator, batch, monkeypatch):
    given = []
    call = Simulator.__call__

    def listen(self, force, **options):
        given.append(options.get("tol"))
        return call(self, force, **options)

    monkeypatch.setattr(Simulator, "__call__", listen)
    rows = list(run_latency.call_times(simulator, batch.load))
    assert [row.call for row in rows] == [
        "surrogate.predict",
        "residual and min det F",
        "sim(force)",
        "  steps in the modes: 0",
        "sim(force, error=1e-3)",
        "sim(force, tol=1e-3)",
        "sim(force, tol=1e-6)",
        *(f"sim(force, tol=1e-8, budget_ms={budget})" for budget in (10, 20, 50, 100)),
    ]
    assert {row.loads for row in rows} == {12}
    assert all(0 < row.p50 <= row.p99 for row in rows)
    assert min(given.count(tol) for tol in (None, 1e-3, 1e-6)) >= 12


def test_loads_are_listed_by_their_number_of_steps(simulator, batch, monkeypatch):
    call = Simulator.__call__

    def second_half_has_a_step(self, force, **options):
        answer = call(self, force, **options)
        later = (force - simulator.scene.si_inputs(batch.load)["force"][6:]).flatten(1).norm(dim=1)
        answer.iterations[:] = int(later.min() == 0)
        return answer

    monkeypatch.setattr(Simulator, "__call__", second_half_has_a_step)
    rows = {row.call: row.loads for row in run_latency.call_times(simulator, batch.load)}
    assert rows["  steps in the modes: 0"] == rows["  steps in the modes: 1"] == 6
    assert rows["sim(force)"] == 12

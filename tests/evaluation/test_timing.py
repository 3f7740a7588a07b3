"""Latency: timed calls, their order, and percentiles."""

from types import SimpleNamespace

import pytest
import torch

from dpl.evaluation import timing
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate


@pytest.fixture
def watch(monkeypatch):
    """A clock that advances only when set [s]."""
    watch = SimpleNamespace(now=0.0)
    monkeypatch.setattr(timing, "time", SimpleNamespace(perf_counter=lambda: watch.now))
    return watch


def test_percentiles_exclude_the_warm_up(watch):
    requested = []

    def answer(load):
        requested.append(load)
        warm = len(requested) > timing.WARM_UP
        watch.now += 1e-3 * (load + 1) if warm else 100.0

    found = timing.latency(answer, range(101), repeats=2)
    assert requested == [*range(timing.WARM_UP), *range(101), *range(101)]
    assert found.loads == 101
    assert found.p50 == pytest.approx(51.0)
    assert found.p99 == pytest.approx(100.0)


def test_calls_are_timed_on_one_thread(monkeypatch):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        seen = set()
        timing.latency(lambda load: seen.add(torch.get_num_threads()), range(3))
        assert seen == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_simulator_and_bare_network_are_timed_on_the_same_loads(scene, batch, monkeypatch):
    torch.manual_seed(0)
    surrogate = Surrogate(FCNN(scene, width=8), MSE(), scene).eval()
    simulator = Simulator(surrogate)
    requested = {"simulator": [], "network": []}

    def reported(name, call):
        def listen(self, force, **more):
            answer = call(self, force, **more)
            requested[name].append((force, answer))
            return answer

        return listen

    monkeypatch.setattr(Simulator, "__call__", reported("simulator", Simulator.__call__))
    monkeypatch.setattr(Surrogate, "forward", reported("network", Surrogate.forward))
    found = timing.latencies(simulator, batch.load)
    assert list(found) == ["sim(force)", "bare network"]
    assert [one.loads for one in found.values()] == [12, 12]
    unit = scene.force_unit * 4500.0
    newtons = [*range(timing.WARM_UP), *range(12)]
    for pairs in requested.values():
        assert len(pairs) == len(newtons)
        for (force, _), k in zip(pairs, newtons, strict=True):
            assert torch.allclose(force, unit * batch.force[k : k + 1], rtol=1e-12)
    for (_, answer), (_, bare) in zip(requested["simulator"], requested["network"], strict=True):
        assert torch.allclose(answer.displacement, bare, rtol=1e-12)
        assert answer.residual.isfinite().all()
        assert answer.volume_ratio.isfinite().all()
        assert len(answer.out_of_distribution) == 1


def test_percentiles_are_interpolated_and_printed_with_two_digits():
    assert timing.percentiles(torch.tensor([4.0, 1.0, 2.0, 3.0]).double())[0] == 2.5
    assert str(timing.Latency(100, 4.61, 112.0)) == "p50 4.6 ms, p99 110 ms"

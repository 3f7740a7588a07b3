"""Times of frames of the page and latencies of the simulator."""

import pytest
from omegaconf import OmegaConf

from benchmarks import mechanics
from benchmarks.tables import read
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate
from dpl.viewer.frames import QUANTITIES, ViewSettings


def test_frames_are_timed_for_each_quantity(scene, monkeypatch, tmp_path):
    frame_rate = pytest.importorskip(
        "benchmarks.frame_rate", reason="the extra viewer is not installed"
    )
    measure_frames, latencies = frame_rate.measure_frames, {}

    def few(body, **options):
        return [body.solve(body.sample(k), ViewSettings()) for k in range(3)]

    def short(page):
        rows, measured = measure_frames(page, seconds=0.1)
        latencies.update(measured)
        return rows, measured

    monkeypatch.setattr(frame_rate, "circular_load", few)
    monkeypatch.setattr(frame_rate, "measure_frames", short)
    monkeypatch.setattr(
        "dpl.load", lambda run: Simulator(Surrogate(FCNN(scene, width=4), MSE(), scene).eval())
    )
    cfg = OmegaConf.create({"run": "runs/a", "folder": str(tmp_path)})
    mechanics.frames(cfg)
    rows = read(frame_rate.FrameTimes, tmp_path / "frames.csv")
    assert [row.quantity for row in rows] == list(QUANTITIES)
    assert all(row.solve_ms > 0 and row.bands_ms > 0 for row in rows)
    assert list(latencies) == ["sim(force)", "bare network"]
    assert all(one.loads == 3 and 0 < one.p50 <= one.p99 for one in latencies.values())

"""`profile=true`: times of frames and latencies of the simulator."""

import pytest

from dpl.viewer.frames import QUANTITIES, ViewSettings


def test_frames_are_timed_for_each_quantity(page, monkeypatch):
    frame_rate = pytest.importorskip(
        "dpl.viewer.frame_rate", reason="the extra viewer is not installed"
    )

    def few(body, **options):
        return [body.solve(body.sample(k), ViewSettings()) for k in range(3)]

    monkeypatch.setattr(frame_rate, "circular_load", few)
    rows, measured = frame_rate.measure_frames(page, seconds=0.1)
    assert [row.quantity for row in rows] == list(QUANTITIES)
    assert all(row.solve_ms > 0 and row.bands_ms > 0 for row in rows)
    assert list(measured) == ["sim(force)", "bare network"]
    assert all(one.loads == 3 and 0 < one.p50 <= one.p99 for one in measured.values())

"""What `speed=true` tells: what frames cost, and the latency of answers by its usual names."""

import pytest

from dpl.viewer.frames import QUANTITIES, ViewSettings


def test_frames_are_timed_for_each_quantity_and_answers_by_their_usual_names(page, monkeypatch):
    speed = pytest.importorskip("dpl.viewer.frame_rate", reason="the extra viewer is not installed")

    def few(body, **options):
        return [body.answer(body.sample(k), ViewSettings()) for k in range(3)]

    monkeypatch.setattr(speed, "answers", few)
    rows, measured = speed.speed(page, seconds=0.1)
    assert [row.colours for row in rows] == list(QUANTITIES)
    assert all(row.coloured > 0 and row.cut > 0 for row in rows)
    assert list(measured) == ["sim(force)", "bare network"]
    assert all(one.loads == 3 and 0 < one.p50 <= one.p99 for one in measured.values())

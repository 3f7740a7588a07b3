"""The worker solves the most recent request; earlier ones are dropped."""

import itertools
import threading
import time
from types import SimpleNamespace

import pytest
import torch

from dpl.viewer.frames import ViewSettings
from dpl.viewer.worker import Worker

LONG = 240.0  # time-out, which no test reaches if the worker works [s]


@pytest.fixture
def shown():
    return []


@pytest.fixture
def make_worker(body, shown, monkeypatch):
    """Function that starts workers, on a clock that advances by 5 ms per reading."""
    ticks = itertools.count()
    clock = SimpleNamespace(monotonic=lambda: 0.005 * next(ticks))
    monkeypatch.setattr("dpl.viewer.worker.time", clock)
    workers = []

    def make(**more):
        worker = Worker(body, shown.append, **more)
        worker.start()
        workers.append(worker)
        assert worker.wait(LONG)
        return worker

    yield make
    for worker in workers:
        worker.stop()
        assert not worker.is_alive()


def test_the_last_frame_has_the_most_recent_load(make_worker, body, shown):
    worker = make_worker(smoothing_time=0.05)
    load = body.sample(1)
    worker.submit(lambda: load)
    assert worker.wait(LONG)
    assert shown[-1].request is load
    assert len(shown) > 3, "the load is smoothed"
    sizes = [float(frame.request.force.norm()) for frame in shown]
    assert sizes == sorted(sizes)


def test_the_load_approaches_zero_load_in_a_few_frames(make_worker, body, shown):
    worker = make_worker(smoothing_time=0.05)
    for make in (lambda: body.sample(1), body.zero_load):
        before = len(shown)
        worker.submit(make)
        assert worker.wait(LONG)
        assert 3 < len(shown) - before < 60
    assert shown[-1].answer.method == "rest"


def test_new_settings_for_the_same_load_give_one_frame(make_worker, body, shown):
    worker = make_worker(smoothing_time=0.05)
    worker.submit(lambda: body.sample(1))
    assert worker.wait(LONG)
    before = len(shown)
    worker.submit(settings=ViewSettings(tol=1e-6))
    assert worker.wait(LONG)
    assert len(shown) == before + 1
    assert shown[-1].converged


def test_without_smoothing_each_load_gives_one_frame(make_worker, body, shown):
    worker = make_worker(smoothing_time=0.0)
    worker.submit(lambda: body.sample(1))
    assert worker.wait(LONG)
    assert len(shown) == 2


def test_of_many_requests_only_the_most_recent_is_solved(make_worker, body, shown):
    worker = make_worker(smoothing_time=0.0)
    requested, first = [], threading.Event()

    def make(index):
        requested.append(index)
        first.wait(LONG)
        return body.sample(index)

    worker.submit(lambda: make(0))
    while not requested:
        time.sleep(0.01)
    for index in range(1, 50):
        worker.submit(lambda index=index: make(index))
    first.set()
    assert worker.wait(LONG)
    assert requested == [0, 49]
    assert torch.equal(shown[-1].request.force, body.sample(49).force)


def test_newton_iterates_are_shown_until_a_new_load_arrives(make_worker, body, shown):
    newton = []
    worker = make_worker(smoothing_time=0.0, min_frame_time=0.02, on_newton=newton.append)
    load = body.sample(1)
    worker.submit(lambda: load, ViewSettings(show_newton=True))
    assert worker.wait(LONG)
    iterates = [frame for frame in newton if frame is not None]
    assert len(iterates) > 3
    assert iterates[-1].converged
    newton.clear()
    worker.min_frame_time = 1e6
    worker.submit(lambda: body.sample(2))
    while not any(newton):
        time.sleep(0.01)
    worker.submit(lambda: body.sample(3), ViewSettings())
    assert worker.wait(LONG)
    assert torch.equal(shown[-1].request.force, body.sample(3).force)


def test_an_error_is_reported_and_the_next_load_is_solved(make_worker, body, shown):
    messages = []
    worker = make_worker(smoothing_time=0.0, on_error=messages.append)
    worker.submit(lambda: body.zero_load(young=1.0))
    assert worker.wait(LONG)
    assert messages
    assert messages[0].startswith("young = 1 must lie between")
    load = body.sample(1)
    worker.submit(lambda: load)
    assert worker.wait(LONG)
    assert shown[-1].request is load

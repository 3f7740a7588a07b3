"""Laws of the worker: the newest wish wins, and nothing is queued."""

import itertools
import threading
import time
from types import SimpleNamespace

import pytest
import torch

from dpl.viewer.frames import ViewSettings
from dpl.viewer.worker import Worker

LONG = 240.0  # no test waits so long, unless what it waits for does not come [s]


@pytest.fixture
def shown():
    return []


@pytest.fixture
def make_worker(body, shown, monkeypatch):
    """Makes running workers, on a clock on which every look takes 5 ms."""
    looks = itertools.count()
    clock = SimpleNamespace(monotonic=lambda: 0.005 * next(looks))
    monkeypatch.setattr("dpl.viewer.worker.time", clock)
    made = []

    def make(**more):
        worker = Worker(body, shown.append, **more)
        worker.start()
        made.append(worker)
        assert worker.settle(LONG)
        return worker

    yield make
    for worker in made:
        worker.stop()
        assert not worker.is_alive()


def test_the_last_frame_is_of_the_newest_load(make_worker, body, shown):
    worker = make_worker(smoothing_time=0.05)
    load = body.sample(1)
    worker.ask(lambda: load)
    assert worker.settle(LONG)
    assert shown[-1].asked is load
    assert len(shown) > 3, "it glides there"
    sizes = [float(frame.asked.force.norm()) for frame in shown]
    assert sizes == sorted(sizes)


def test_it_glides_to_no_load_in_a_moment(make_worker, body, shown):
    worker = make_worker(smoothing_time=0.05)
    for make in (lambda: body.sample(1), body.rest):
        before = len(shown)
        worker.ask(make)
        assert worker.settle(LONG)
        assert 3 < len(shown) - before < 60
    assert shown[-1].answer.method == "rest"


def test_another_wish_for_the_same_load_is_one_frame(make_worker, body, shown):
    worker = make_worker(smoothing_time=0.05)
    worker.ask(lambda: body.sample(1))
    assert worker.settle(LONG)
    before = len(shown)
    worker.ask(wish=ViewSettings(tol=1e-6))
    assert worker.settle(LONG)
    assert len(shown) == before + 1
    assert shown[-1].converged


def test_without_a_glide_there_is_one_frame_for_a_load(make_worker, body, shown):
    worker = make_worker(smoothing_time=0.0)
    worker.ask(lambda: body.sample(1))
    assert worker.settle(LONG)
    assert len(shown) == 2


def test_of_many_wishes_only_the_newest_is_answered(make_worker, body, shown):
    worker = make_worker(smoothing_time=0.0)
    asked, first = [], threading.Event()

    def make(index):
        asked.append(index)
        first.wait(LONG)
        return body.sample(index)

    worker.ask(lambda: make(0))
    while not asked:
        time.sleep(0.01)
    for index in range(1, 50):
        worker.ask(lambda index=index: make(index))
    first.set()
    assert worker.settle(LONG)
    assert asked == [0, 49]
    assert torch.equal(shown[-1].asked.force, body.sample(49).force)


def test_newton_is_shown_step_by_step_and_a_new_load_ends_it(make_worker, body, shown):
    beside = []
    worker = make_worker(smoothing_time=0.0, min_frame_time=0.02, beside=beside.append)
    load = body.sample(1)
    worker.ask(lambda: load, ViewSettings(compare=True))
    assert worker.settle(LONG)
    iterates = [frame for frame in beside if frame is not None]
    assert len(iterates) > 3
    assert iterates[-1].converged
    beside.clear()
    worker._pace = 1e6
    worker.ask(lambda: body.sample(2))
    while not any(beside):
        time.sleep(0.01)
    worker.ask(lambda: body.sample(3), ViewSettings())
    assert worker.settle(LONG)
    assert torch.equal(shown[-1].asked.force, body.sample(3).force)


def test_trouble_is_told_and_the_next_load_is_answered(make_worker, body, shown):
    told = []
    worker = make_worker(smoothing_time=0.0, trouble=told.append)
    worker.ask(lambda: body.rest(young=1.0))
    assert worker.settle(LONG)
    assert told
    assert told[0].startswith("E = 1 Pa must lie")
    load = body.sample(1)
    worker.ask(lambda: load)
    assert worker.settle(LONG)
    assert shown[-1].asked is load

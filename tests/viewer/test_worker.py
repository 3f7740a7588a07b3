"""The worker solves the most recent request; earlier ones are dropped."""

import itertools
import threading
import time
from dataclasses import replace
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

    def make(*, smoothing_time=0.0, **more):
        worker = Worker(body, shown.append, **more)
        worker.smoothing_time = smoothing_time
        worker.start()
        workers.append(worker)
        assert worker.wait(LONG)
        return worker

    yield make
    for worker in workers:
        worker.stop()
        assert not worker.is_alive()


@pytest.fixture
def patch(body, tip):
    """The patch at the tip."""
    return body.patch(tip, 0.3)


def lifted(body, patch, height):
    """Return a grasp that lifts a patch by a height over L."""
    rotation = torch.zeros(3).double()
    return body.grasp(patch.held_nodes, torch.tensor([0.0, 0.0, height]).double(), rotation)


@pytest.mark.parametrize("kind", ["load", "grasp"])
def test_requests_are_smoothed_on_the_way_to_the_most_recent_one(
    make_worker, body, shown, patch, kind
):
    worker = make_worker(smoothing_time=0.05)
    goals = [body.sample(1), body.zero_load()]
    if kind == "grasp":
        goals = [lifted(body, patch, height) for height in (0.01, 0.06)]
    for goal in goals:
        before = len(shown)
        worker.submit(lambda goal=goal: goal)
        assert worker.wait(LONG)
        assert shown[-1].request is goal
    assert 3 < len(shown) - before < 60
    sizes = [float(getattr(frame.request, "translation", frame.request.force).norm())
             for frame in shown[before:]]  # fmt: skip
    assert sizes == sorted(sizes, reverse=kind == "load")
    assert len(set(sizes)) > 3


def test_there_is_one_frame_where_nothing_can_be_interpolated(make_worker, body, shown, patch):
    """Between a load and a grasp, for new settings of the same load, and without smoothing."""
    worker = make_worker(smoothing_time=0.05)
    for make, settings in (
        (lambda: lifted(body, patch, 0.05), None),
        (body.zero_load, None),
        (None, ViewSettings(tol=1e-6)),
    ):
        before = len(shown)
        worker.submit(make, settings)
        assert worker.wait(LONG)
        assert len(shown) == before + 1
    assert shown[-1].answer.converged
    before, worker = len(shown) + 1, make_worker()
    worker.submit(lambda: body.sample(1))
    assert worker.wait(LONG)
    assert len(shown) == before + 1


def test_the_time_of_a_solve_is_known_while_it_lasts(make_worker, body):
    worker = make_worker()
    assert worker.solving_time == 0
    began, end = threading.Event(), threading.Event()

    def make():
        began.set()
        end.wait(LONG)
        raise ValueError("no load")

    worker.submit(make)
    assert began.wait(LONG)
    assert worker.solving_time > 0
    end.set()
    assert worker.wait(LONG)
    assert worker.solving_time == 0


def test_of_many_requests_only_the_most_recent_is_solved(make_worker, body, shown):
    worker = make_worker()
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
    worker = make_worker(on_newton=newton.append)
    worker.min_frame_time = 0.02
    load = body.sample(1)
    worker.submit(lambda: load, ViewSettings(show_newton=True))
    assert worker.wait(LONG)
    iterates = [frame for frame in newton if frame is not None]
    assert len(iterates) > 3
    assert iterates[-1].answer.converged
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
    worker = make_worker(on_error=messages.append)
    worker.submit(lambda: replace(body.zero_load(), young=-1.0))
    assert worker.wait(LONG)
    assert messages == ["young: a modulus is not above 0 Pa"]
    load = body.sample(1)
    worker.submit(lambda: load)
    assert worker.wait(LONG)
    assert shown[-1].request is load

"""Laws of a growing training set: its loads, their number, its limits and its end."""

import itertools
import multiprocessing
from types import SimpleNamespace

import pytest
import torch

from dpl.data import DataModule, DataSet, Growing, dataset, sources
from dpl.data.dataset import LoadSolver
from dpl.data.storage import store as store_module
from dpl.system.files import DataSetError, exclusive_lock

BLOCK = 4


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Fits begin with four loads."""
    for module in (sources, store_module):
        monkeypatch.setattr(module, "SHARD_SIZE", BLOCK)
    monkeypatch.setattr(sources, "HELD_OUT", 2)


@pytest.fixture
def module(scene, tmp_path):
    """Return a function that builds growing data modules of one folder."""
    made = []

    def module(**options):
        sizes = {"val": 6, "test": 2, "workers": 0}
        data = DataModule(scene, folder=str(tmp_path / "d"), train=Growing(**options), **sizes)
        data.fits = data.source.fits(data.dataset)
        made.append(data)
        return data

    yield module
    for one in made:
        one.teardown("fit")


def errors(median):
    return {"median": median, "worst": 2 * median, "e_mean": median}


def step(data, median):
    """Grow the training set and record an error; return the number of training loads."""
    data.sizes |= next(data.fits)
    data.source.record(data.sizes["train"], errors(median))
    return data.sizes["train"]


def test_each_fit_has_more_loads_of_the_data_set_of_its_seed(module, scene, tmp_path):
    data = module(max_train=16)
    found = [(step(data, error), len(data.samples("val").force)) for error in (1.0, 0.9, 0.8)]
    assert found == [(4, 2), (8, 4), (12, 6)]
    whole = DataModule(scene, folder=str(tmp_path / "e"), train=12, val=6, test=1, workers=0)
    whole.prepare_data()
    assert torch.equal(data.samples("train").force, whole.samples("train").force)
    assert torch.equal(data.samples("train").displacement, whole.samples("train").displacement)
    assert torch.equal(data.samples("val").force, whole.samples("val").force[:6])


@pytest.mark.parametrize("limit", [{"error": 0.5}, {"max_train": 6}])
def test_it_ends_with_all_loads_of_validation_and_test(module, limit):
    data = module(**limit)
    step(data, 1.0)
    step(data, 0.4)
    assert next(data.fits, None) is None
    data.teardown("fit")
    assert data.source.count(data.store) == limit.get("max_train", 8)
    assert not data.store.missing("val", 6)
    assert not data.store.missing("test", 2)


@pytest.mark.parametrize(("error", "sizes"), [(1e-3, [8]), (0.5, [])])
def test_a_growth_is_continued_from_its_state(module, error, sizes):
    before = module(max_train=8)
    step(before, 0.4)
    before.teardown("fit")
    after = module(max_train=8, error=error)
    after.load_state_dict(before.state_dict())
    assert after.source.points == before.source.points
    for expected in sizes:
        assert step(after, 0.4) == expected
    assert next(after.fits, None) is None


def test_it_ends_before_a_fit_that_would_exceed_the_time(module, monkeypatch):
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(sources.time, "monotonic", lambda: clock.now)
    data = module(minutes=1.0)
    next(data.fits)
    clock.now = 20.0
    assert "minutes" not in data.source.record(4, errors(1.0))
    next(data.fits)
    clock.now = 45.0
    assert "data.train.minutes = 1 reached" in data.source.record(8, errors(1.0))
    assert next(data.fits, None) is None


def test_it_ends_after_two_fits_without_gain(module):
    growth = module(max_train=1000).source
    for loads, median in ((64, 0.5), (128, 0.4), (192, 0.39)):
        assert "without gain" not in growth.record(loads, errors(median))
    assert not growth.is_finished
    line = growth.record(320, errors(0.41))
    assert "2 fits without gain: more loads no longer reduce the error" in line
    assert growth.is_finished


def test_an_interrupted_growth_solves_no_test_loads(module):
    data = module()
    step(data, 1.0)
    data.teardown("fit")
    assert len(data.store.missing("test", 2)) == 2
    data.teardown("fit")  # as Lightning and the command both do


def test_loads_that_are_there_are_not_solved_again(module, monkeypatch):
    first = module(max_train=8)
    assert [step(first, 1.0), step(first, 0.9)] == [4, 8]
    first.teardown("fit")
    monkeypatch.setattr("dpl.data.solving.worker_pool.solve_load", None)
    second = module(max_train=8)
    assert step(second, 1.0) == 4, "a learning curve starts with few loads"
    assert step(second, 0.9) == 8


def test_loads_that_are_there_are_taken_but_no_more_than_predicted(module, scene, tmp_path):
    DataSet(scene, str(tmp_path / "d"), train=40, val=6, test=2, workers=0).fill()
    data = module(error=1.0 / 24.5)
    assert [step(data, 1 / 4), step(data, 1 / 16), next(data.fits)["train"]] == [4, 16, 28]
    fast = module()
    assert [step(fast, error) for error in (1.0, 1.0, 1.0)] == [4, 16, 40]


def test_a_set_that_grew_is_read_as_a_whole_by_later_commands(module):
    data = module(max_train=8)
    step(data, 1.0)
    step(data, 1.0)
    data.teardown("fit")
    later = module(max_train=8)
    later.prepare_data()
    assert len(later.snapshots().force) == 8


def test_the_errors_of_a_fit_are_those_of_the_loads_that_follow(module):
    data = module(max_train=10)
    unseen = []
    for error in (1.0, 0.9, 0.8):
        step(data, error)
        unseen.append(data.source.unseen(data.store, data.sizes["train"]))
    whole = data.store.load("train", 10).force
    assert torch.equal(unseen[0].force, whole[4:8])
    assert torch.equal(unseen[1].force, whole[8:10])
    assert unseen[2] is None, "there is no load after the last one"


# ------------------------------------------------------------------ in the background


def test_a_worker_solves_in_the_background(scene, tmp_path):
    data = DataSet(scene, str(tmp_path / "d"), workers=1)
    before = multiprocessing.active_children()
    endless = (("train", range(k, k + 1)) for k in range(10**6))
    solver = LoadSolver(data, itertools.chain([("val", range(2))], endless), thread=True)
    solver.wait({"train": 3, "val": 2})
    assert solver.count("train") >= 3
    assert len(data.store.load("train", 3).force) == 3, "also loads whose files are not merged"
    solver.wait({"train": 6})
    solver.close()
    assert 6 <= solver.count("train") < 10**6, "a closed solver starts no load"
    assert multiprocessing.active_children() == before
    assert len(data.store.load("train", 6).force) == 6


def test_a_wait_ends_with_the_loads(scene, tmp_path):
    data = DataSet(scene, str(tmp_path / "d"), workers=0)
    solver = LoadSolver(data, [("train", range(2))])
    solver.wait({"train": 9})
    assert solver.count("train") == 2
    solver.close()


@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_of_the_solver_is_raised_where_it_is_waited_for(scene, tmp_path, workers):
    data = DataSet(scene, str(tmp_path / "d"), workers=workers)
    data.create()
    with exclusive_lock(data.store.folder, 0, 1):
        solver = LoadSolver(data, [("train", range(6))], thread=workers > 0)
        with pytest.raises(DataSetError):
            solver.wait({"train": 1})
        solver.close()


def test_a_wait_ends_at_its_time(scene, tmp_path, monkeypatch):
    data = DataSet(scene, str(tmp_path / "d"), workers=0)
    solver = LoadSolver(data, [("train", range(6))])
    ticks = iter([0.0, 1.0, 2.0, 3.0])
    monkeypatch.setattr(dataset.time, "monotonic", lambda: next(ticks))
    solver.wait({"train": 6}, until=2.0)
    assert solver.count("train") == 2
    solver.close()

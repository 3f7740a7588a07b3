"""Laws of the data modules: what they hand to Lightning, in which order, and from where."""

import itertools
import multiprocessing

import pytest
import torch

from dpl.data.datamodule import OfflineData, OnlineData
from dpl.data.generate import outcome
from dpl.scene import Sample


@pytest.fixture
def offline(scene, folder, data):
    """Builds data modules on the tiny data set."""

    def offline(**options):
        defaults = {"train": 12, "val": 4, "test": 4, "batch_size": 4, "workers": 0}
        return OfflineData(scene, folder=str(folder), **{**defaults, **options})

    return offline


@pytest.fixture
def online(scene, folder, data):
    """Builds streams that validate on the tiny data set."""

    def online(**options):
        defaults = {
            "val": 4,
            "test": 4,
            "workers": 0,
            "batch_size": 4,
            "batches": 3,
            "fresh": 4,
            "reuse": 1,
            "capacity": 64,
        }
        return OnlineData(scene, folder=str(folder), **{**defaults, **options})

    return online


def order(module, epoch):
    loader = module.train_dataloader()
    loader.sampler.set_epoch(epoch)
    return [force.numpy().tobytes() for batch in loader for force in batch.force]


def forces(batches):
    return [force.numpy().tobytes() for batch in batches for force in batch.force]


def test_an_epoch_holds_every_sample_once(offline):
    module = offline(batch_size=5)
    batches = list(module.train_dataloader())
    assert [len(batch.force) for batch in batches] == [5, 5, 2]
    assert sorted(forces(batches)) == sorted(forces([module.samples("train")]))
    assert all(isinstance(batch, Sample) for batch in batches)


def test_batches_are_a_function_of_shuffle_and_epoch(offline):
    first = order(offline(shuffle=3), epoch=2)
    assert order(offline(shuffle=3), epoch=2) == first
    assert order(offline(shuffle=3), epoch=3) != first
    assert order(offline(shuffle=4), epoch=2) != first


def test_validation_and_test_keep_their_order(offline):
    module = offline(batch_size=3)
    assert forces(module.val_dataloader()) == forces([module.samples("val")])
    assert forces(module.test_dataloader()) == forces([module.samples("test")])


def test_splits_are_disjoint(offline):
    module = offline()
    splits = [set(forces([module.samples(split)])) for split in ("train", "val", "test")]
    assert [len(split) for split in splits] == [12, 4, 4]
    assert len(set.union(*splits)) == 20


def test_batches_keep_double_precision(offline):
    batch = next(iter(offline().train_dataloader()))
    assert all(column.dtype == torch.float64 for column in batch)


def test_the_plan_counts_what_is_there(offline, scene, tmp_path):
    (line,) = offline().plan()
    assert line.startswith("20 of 20 loads not solved again")
    (line,) = offline(train=30).plan()
    assert line.startswith("20 of 38 loads not solved again")
    assert OfflineData(scene, folder=str(tmp_path / "new"), workers=0).plan() == []
    assert not (tmp_path / "new").exists(), "a plan computes nothing and writes nothing"


def test_preparing_twice_solves_nothing(offline, monkeypatch):
    def forbidden(*_):
        raise AssertionError("solved again")

    monkeypatch.setattr("dpl.data.generate.outcome", forbidden)
    offline().prepare_data()


@pytest.mark.parametrize(
    "options",
    [{"train": -1}, {"val": 0}, {"test": 0}, {"batch_size": 0}, {"workers": -1}, {"seed": -1}],
    ids=lambda options: next(iter(options)),
)
def test_options_out_of_range_are_refused_by_name(offline, options):
    with pytest.raises(ValueError, match=f"{next(iter(options))} = "):
        offline(**options)


@pytest.mark.parametrize(
    "options",
    [{"batches": 0}, {"fresh": 0}, {"reuse": 0}, {"capacity": 3}],
    ids=lambda options: next(iter(options)),
)
def test_options_of_the_stream_out_of_range_are_refused_by_name(online, options):
    with pytest.raises(ValueError, match=f"{next(iter(options))} = "):
        online(**options)


def test_the_stream_solves_the_loads_that_the_data_set_would_hold(online, offline):
    batches = list(online(batches=10, batch_size=12, fresh=12, reuse=10).train_dataloader())
    assert set(forces(batches)) == set(forces([offline().samples("train")]))


def test_the_stream_validates_on_the_data_set(online, offline):
    assert forces(online().val_dataloader()) == forces(offline().val_dataloader())
    assert forces(online().test_dataloader()) == forces(offline().test_dataloader())


def test_preparing_a_stream_solves_no_training_load(online, scene, tmp_path, monkeypatch):
    seen = []

    def counted(scene, job):
        seen.append(job.seed)
        return outcome(scene, job)

    monkeypatch.setattr("dpl.data.generate.outcome", counted)
    module = OnlineData(scene, folder=str(tmp_path / "d"), val=2, test=3, workers=0)
    module.prepare_data()
    assert sorted(seen) == [(0, 1)] * 2 + [(0, 2)] * 3


def test_a_resumed_stream_goes_on_where_it_was_left(online):
    module = online()
    first = set(forces(module.train_dataloader()))
    state = module.state_dict()
    assert state["produced"] == 12
    resumed = online()
    resumed.load_state_dict(state)
    second = set(forces(resumed.train_dataloader()))
    assert not first & second
    assert resumed.state_dict()["produced"] == 24


def test_a_resumed_stream_draws_no_load_twice_where_some_are_rejected(online, monkeypatch):
    def choosy(scene, job):
        return outcome(scene, job)._replace(accepted=job.number % 3 == 1)

    monkeypatch.setattr("dpl.data.online.outcome", choosy)
    module = online()
    first = set(forces(module.train_dataloader()))
    resumed = online()
    resumed.load_state_dict(module.state_dict())
    assert not first & set(forces(resumed.train_dataloader()))


def test_a_resumed_stream_of_two_workers_draws_no_load_twice(online):
    module = online(workers=2, batches=3, fresh=4, batch_size=64, reuse=16)
    first = set(forces(itertools.islice(module.train_dataloader(), 3)))
    state = module.state_dict()
    module.teardown("fit")
    assert not multiprocessing.active_children()
    resumed = online(batches=3, fresh=4, batch_size=64, reuse=16)
    resumed.load_state_dict(state)
    assert not first & set(forces(resumed.train_dataloader()))

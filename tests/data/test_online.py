"""Laws of the endless stream: whoever solves it, every load once, and no process left behind."""

import itertools
import multiprocessing
from pathlib import Path

import pytest
import torch
from torch.utils.data import IterableDataset

from dpl.data.generate import Job, outcome
from dpl.data.online import Drawn, OnlineSamples, Replay
from dpl.scene import Sample

SEED = (0, 0)


class Numbers(IterableDataset):
    """Samples whose modulus is their place in the stream."""

    def __init__(self, end=None):
        self.end = end

    def __iter__(self):
        for place in itertools.count() if self.end is None else range(self.end):
            field = torch.full((2, 3), float(place), dtype=torch.float64)
            young = torch.tensor(float(place), dtype=torch.float64)
            yield Drawn(Sample(field, -field, young), torch.tensor(place))


def replay(stream=None, **options):
    defaults = {
        "workers": 0,
        "batch_size": 8,
        "batches": 10,
        "fresh": 4,
        "reuse": 6,
        "capacity": 100,
    }
    return Replay(stream or Numbers(), **{**defaults, **options})


def keys(batch):
    return {force.numpy().tobytes() for force in batch.force}


@pytest.fixture(scope="module")
def drawn(scene):
    """The first loads of the stream, as bytes by place."""
    return [f.numpy().tobytes() for f in scene.loads.sample(SEED, range(32)).force]


def test_the_stream_is_the_accepted_loads_in_order(scene, drawn):
    first = list(itertools.islice(OnlineSamples(scene, SEED), 6))
    assert [one.sample.force.numpy().tobytes() for one in first] == drawn[:6]
    assert [int(one.number) for one in first] == list(range(6))
    truth = outcome(scene, Job(SEED, 3))
    assert torch.equal(first[3].sample.displacement, torch.from_numpy(truth.displacement))
    assert float(first[3].sample.young) == truth.young


def test_the_stream_can_begin_anywhere(scene, drawn):
    first = next(iter(OnlineSamples(scene, SEED, first=9)))
    assert first.sample.force.numpy().tobytes() == drawn[9]


def test_rejected_loads_do_not_enter_the_stream(scene, drawn, monkeypatch):
    def choosy(scene, job):
        return outcome(scene, job)._replace(accepted=job.number % 3 == 1)

    monkeypatch.setattr("dpl.data.online.outcome", choosy)
    first = itertools.islice(OnlineSamples(scene, SEED), 3)
    assert [one.sample.force.numpy().tobytes() for one in first] == [drawn[1], drawn[4], drawn[7]]


def test_two_workers_solve_the_same_stream_and_end_when_it_is_closed(scene, drawn):
    before = {child.pid for child in multiprocessing.active_children()}
    options = {"fresh": 4, "batch_size": 256, "reuse": 64, "batches": 4}
    stream = replay(OnlineSamples(scene, SEED), workers=2, **options)
    seen = set().union(*[keys(batch) for batch in stream])
    crew = {child.pid for child in multiprocessing.active_children()} - before
    assert len(crew) == 2
    assert stream.produced == 16
    assert seen == set(drawn[:16]), "no load is left out and none is solved by both"
    next(iter(stream))  # the next epoch goes on with the same workers
    assert {child.pid for child in multiprocessing.active_children()} - before == crew
    stream.close()
    assert not crew & {child.pid for child in multiprocessing.active_children()}
    assert not any(Path(f"/proc/{pid}").exists() for pid in crew)


def test_batches_are_samples_with_a_leading_batch_axis():
    batch = next(iter(replay()))
    assert isinstance(batch, Sample)
    assert batch.force.shape == batch.displacement.shape == (8, 2, 3)
    assert batch.young.shape == (8,)
    assert torch.equal(batch.force[:, 0, 0], batch.young), "columns are drawn together"


def test_an_epoch_has_its_number_of_batches_for_ever():
    stream = replay(batches=7)
    assert len(stream) == 7
    for _ in range(5):
        assert sum(1 for _ in stream) == 7


def test_epochs_go_on_with_the_stream():
    stream = replay(batches=6, reuse=2, fresh=4, batch_size=8)
    newest = [max(float(batch.young.max()) for batch in stream) for _ in range(4)]
    assert stream.produced == 4 * 6 * 8 // 2
    assert newest == sorted(newest)
    assert newest[-1] > 3 * newest[0]


@pytest.mark.parametrize("reuse", [1, 5, 50])
def test_samples_are_used_as_often_as_promised_on_average(reuse):
    stream = replay(reuse=reuse, batches=1, fresh=4, batch_size=8)
    for drawn in range(1, 200):
        next(iter(stream))
        assert drawn * 8 <= stream.produced * reuse, "no more uses than the samples are good for"
        assert (stream.produced - 4) * reuse < drawn * 8, "no sample is taken before it is needed"


def test_training_starts_with_the_first_samples():
    stream = replay(reuse=50, fresh=4)
    batch = next(iter(stream))
    assert stream.produced == 4
    assert set(batch.young.tolist()) <= {0.0, 1.0, 2.0, 3.0}


def test_the_oldest_samples_leave_a_full_buffer():
    stream = replay(capacity=12, fresh=4, reuse=2, batches=1)
    for _ in range(50):
        batch = next(iter(stream))
        assert batch.young.min() >= stream.produced - 12
        assert batch.young.max() < stream.produced


def test_all_samples_of_the_buffer_are_drawn():
    stream = replay(capacity=16, fresh=16, reuse=100, batch_size=100, batches=8)
    counts = torch.bincount(torch.cat([batch.young for batch in stream]).long(), minlength=16)
    assert counts.min() > 20  # 800 draws from 16


def test_two_streams_give_the_same_batches():
    one, other = replay(), replay()
    for a, b in itertools.islice(zip(one, other, strict=True), 10):
        assert torch.equal(a.young, b.young)


def test_a_closed_stream_can_be_closed_again():
    stream = replay()
    next(iter(stream))
    stream.close()
    stream.close()

"""Laws of the stream and the replay buffer: each load once and in order, bounded reuse, rates."""

import itertools
import multiprocessing
import threading
import weakref
from pathlib import Path

import pytest
import torch

from dpl import Sample
from dpl.data import stream as stream_module
from dpl.data.solving.solve import LoadKey, solve_load
from dpl.data.stream import ReplayBuffer, Stream, accepted_samples

SEED = (0, 0)


class Numbers:
    """Samples like `accepted_samples` without mechanics; the modulus is the number of the load.

    Attributes:
        end: Number at which it ends; None: never.
    """

    def __init__(self, end=None, *, shape=(2, 3)):
        self.end, self.shape = end, shape

    def __iter__(self):
        for place in itertools.count():
            if place == self.end:
                return
            yield place, self.drawn(place)

    def drawn(self, place):
        field = torch.full(self.shape, float(place), dtype=torch.float64)
        return Sample(field, -field, torch.tensor(float(place), dtype=torch.float64))


@pytest.fixture
def replay():
    """Return a function that builds replay buffers."""

    def replay(stream=None, batch_size=8, seed=0, **sizes):
        sizes = {"batches": 10, "new_per_round": 4, "reuse": 6, "capacity": 100, **sizes}
        return ReplayBuffer(stream or Numbers(), Stream(**sizes), batch_size, seed)

    return replay


def children():
    return {child.pid for child in multiprocessing.active_children()}


def places(batch):
    return batch.young.long().tolist()


def taken(stream, count):
    """Return the numbers and the forces, as bytes, of the first samples of a stream."""
    found = list(itertools.islice(stream, count))
    return [number for number, _ in found], [one.force.numpy().tobytes() for _, one in found]


@pytest.fixture(scope="module")
def drawn(scene):
    """The forces of the first loads of the stream, as bytes."""
    return [f.numpy().tobytes() for f in scene.loads.sample(SEED, range(32)).force]


# ------------------------------------------------------------------ the stream


def test_the_stream_is_the_accepted_loads_in_order(make_scene):
    scene = make_scene(young=[1e6, 2e11])
    found = list(itertools.islice(accepted_samples(scene, SEED, first=2), 6))
    truth = scene.loads.sample(SEED, range(2, 8))
    assert [number for number, _ in found] == list(range(2, 8))
    for (number, one), force, young in zip(found, truth.force, truth.young, strict=True):
        assert torch.equal(one.force, force)
        assert torch.equal(one.young, young)
        solved = solve_load(scene, LoadKey(SEED, number)).displacement
        assert torch.equal(one.displacement, torch.from_numpy(solved))


def choosy(scene, jobs, **options):
    for job in jobs:
        yield solve_load(scene, job)._replace(accepted=job.number % 3 == 1)


def backwards(scene, jobs, **options):
    """Solve loads as workers of different speed do: in blocks of four, the last one first."""
    while block := list(itertools.islice(jobs, 4)):
        yield from [solve_load(scene, job) for job in block[::-1]]


def without_two(scene, jobs, **options):
    """Solve all loads but number 2, which comes late."""
    late = None
    for job in jobs:
        if job.number == 2:
            late = job
            continue
        yield solve_load(scene, job)
        if job.number == 12:
            yield solve_load(scene, late)


@pytest.mark.parametrize("workers", [0, 1], ids=["here", "in a thread"])
@pytest.mark.parametrize(
    ("solve", "numbers"),
    [
        (choosy, [1, 4, 7, 10]),
        (backwards, [0, 1, 2, 3, 4, 5]),
        (without_two, [0, 1, *range(3, 18)]),
    ],
)
def test_samples_are_in_order_without_rejected_and_late_loads(
    scene, drawn, monkeypatch, solve, numbers, workers
):
    monkeypatch.setattr(stream_module, "solve_loads", solve)
    monkeypatch.setattr(stream_module, "MAX_EARLY", 6)
    stream = accepted_samples(scene, SEED, workers=workers)
    assert taken(stream, len(numbers)) == (numbers, [drawn[k] for k in numbers])
    stream.close()
    assert not any(thread.name == "background" for thread in threading.enumerate())


@pytest.mark.parametrize("world_size", [2, 3])
def test_training_processes_solve_disjoint_loads_that_cover_the_stream(scene, world_size):
    streams = [accepted_samples(scene, SEED, 4 + k, world_size) for k in range(world_size)]
    seen = itertools.chain(*(taken(stream, 4)[0] for stream in streams))
    assert sorted(seen) == list(range(4, 4 + 4 * world_size))


def test_workers_solve_the_stream_and_end_when_it_is_closed(scene, drawn):
    before = children()
    stream = accepted_samples(scene, SEED, workers=1, timeout=600.0)
    assert taken(stream, 12) == (list(range(12)), drawn[:12])
    started = children() - before
    assert len(started) == 1
    stream.close()
    assert not started & children()
    assert not any(Path(f"/proc/{pid}").exists() for pid in started)


def test_loads_are_solved_ahead_but_not_without_end(scene, monkeypatch):
    solved, enough = [], threading.Event()

    def counted(scene, jobs, **options):
        for job in jobs:
            solved.append(job.number)
            if len(solved) == 1 + stream_module.AHEAD + 1:
                enough.set()
            yield solve_load(scene, job)

    monkeypatch.setattr(stream_module, "solve_loads", counted)
    stream = accepted_samples(scene, SEED, workers=1)
    next(stream)
    assert enough.wait(60)
    stream.close()
    assert len(solved) == 1 + stream_module.AHEAD + 1, "one is taken, one waits for its place"


def test_an_error_is_raised_where_a_sample_is_needed(scene, monkeypatch):
    def faulty(scene, jobs, **options):
        yield solve_load(scene, next(jobs))
        raise RuntimeError("12 workers died in a row")

    monkeypatch.setattr(stream_module, "solve_loads", faulty)
    samples = accepted_samples(scene, SEED, workers=1)
    next(samples)
    with pytest.raises(RuntimeError, match="died in a row"):
        next(samples)


# ------------------------------------------------------------------ epochs


def test_batches_are_samples_with_a_leading_batch_axis(replay):
    stream = replay()
    assert (len(stream), stream.produced) == (10, 0), "nothing starts before the first batch"
    batch = next(iter(stream))
    assert isinstance(batch, Sample)
    assert batch.force.shape == batch.displacement.shape == (8, 2, 3)
    assert batch.young.shape == (8,)
    assert torch.equal(batch.force[:, 0, 0], batch.young), "columns are drawn together"
    assert torch.equal(batch.displacement, -batch.force)


def test_the_next_epoch_has_as_many_batches_and_continues_the_stream(replay):
    stream = replay(batches=6, reuse=2, new_per_round=4, batch_size=8)
    epochs = [list(stream) for _ in range(4)]
    assert [len(batches) for batches in epochs] == [6] * 4
    newest = [max(float(batch.young.max()) for batch in batches) for batches in epochs]
    assert newest == sorted(newest)
    assert newest[-1] > 3 * newest[0]


def test_a_stream_that_ends_ends_the_epoch(replay):
    stream = replay(Numbers(end=20), reuse=2, batches=100, capacity=8)
    used = sum(len(batch.young) for batch in stream)
    assert stream.produced == 20
    assert 20 - 8 <= used <= 40


# ------------------------------------------------------------------ how often a sample is used


def counted(stream, batches):
    """Return the number of uses of each load in a number of batches."""
    used = [place for _ in range(batches) for place in places(next(iter(stream)))]
    return torch.bincount(torch.tensor(used), minlength=stream.produced)


@pytest.mark.parametrize(
    ("reuse", "new_per_round", "capacity"),
    [(1, 5, 42), (1, 3, 1000), (2, 8, 8), (6, 5, 12), (50, 4, 16)],
)
def test_no_sample_is_used_more_than_reuse_times(replay, reuse, new_per_round, capacity):
    stream = replay(reuse=reuse, batches=1, new_per_round=new_per_round, capacity=capacity)
    used = counted(stream, 100 if reuse > 1 else 60)
    assert used.max() <= reuse
    assert reuse > 1 or (used[:-5] == 1).all(), "none is lost"


@pytest.mark.parametrize("reuse", [2, 50])
def test_samples_are_used_half_as_often_while_the_buffer_fills(replay, reuse):
    stream = replay(reuse=reuse, batches=1, capacity=10_000)
    for drawn in range(1, 200):
        next(iter(stream))
        assert drawn * 8 <= stream.produced * reuse / 2, "no more than they are good for"
        assert (stream.produced - 4) * reuse / 2 < drawn * 8, "none is taken before it is needed"


@pytest.mark.parametrize("reuse", [2, 50])
def test_samples_are_used_reuse_times_on_average_once_the_buffer_is_full(replay, reuse):
    stream = replay(reuse=reuse, batches=1, capacity=64)
    while stream.produced <= 64:
        next(iter(stream))
    produced, used = stream.produced, 0
    for _ in range(20 * reuse):
        used += len(next(iter(stream)).young)
    assert used == pytest.approx((stream.produced - produced) * reuse, abs=4 * reuse + 8)


def test_no_sample_is_twice_in_a_batch_if_there_are_enough(replay):
    stream = replay(batches=1, new_per_round=8, reuse=4, capacity=64, batch_size=8)
    for _ in range(100):
        assert len(set(places(next(iter(stream))))) == 8


@pytest.mark.parametrize(("capacity", "reuse", "batch_size"), [(4, 12, 16), (12, 2, 8)])
def test_a_batch_holds_the_newest_samples_even_if_it_is_larger_than_the_buffer(
    replay, capacity, reuse, batch_size
):
    stream = replay(batches=1, reuse=reuse, capacity=capacity, batch_size=batch_size)
    for _ in range(50):
        batch = next(iter(stream))
        assert len(batch.young) == batch_size
        assert stream.produced - capacity <= batch.young.min()
        assert batch.young.max() < stream.produced


def test_all_samples_of_the_buffer_are_drawn(replay):
    stream = replay(capacity=16, new_per_round=16, reuse=100, batch_size=100, batches=8)
    counts = torch.bincount(torch.cat([batch.young for batch in stream]).long(), minlength=16)
    assert counts.min() > 20  # 800 draws from 16


def test_batches_stay_mixed_however_long_it_runs(replay):
    """A batch holds old and new samples."""
    stream = replay(capacity=256, new_per_round=8, reuse=4, batch_size=32, batches=1)
    for _ in range(160):
        batch = next(iter(stream))
    ages = []
    for _ in range(40):
        batch = next(iter(stream))
        assert len(set(places(batch))) == 32
        ages.append(stream.produced - batch.young)
    assert torch.cat(ages).mean() > 256 / 8
    assert torch.cat(ages).max() > 256 / 2


def test_batches_are_a_function_of_the_seed(replay):
    """The samples are the same; their order is not."""

    def order(seed):
        stream = replay(seed=seed, reuse=1, new_per_round=8)
        return [place for batch in stream for place in places(batch)]

    assert order(1) == order(1) != order(2)
    assert sorted(order(1)) == sorted(order(2))


def test_samples_that_leave_the_buffer_are_freed(replay):
    alive = []

    class Watched(Numbers):
        def drawn(self, place):
            sample = super().drawn(place)
            alive.append(weakref.ref(sample.force))
            return sample

    stream = replay(Watched(), new_per_round=4, capacity=8, reuse=2, batch_size=4, batches=50)
    for _ in stream:
        assert sum(one() is not None for one in alive) <= 8 + 4
    assert stream.produced > 50


# ------------------------------------------------------------------ rates


class Clocked(Numbers):
    """A stream with a simulated clock that advances by 5 ms per sample.

    Attributes:
        now: Time [s].
    """

    now = 100.0

    def drawn(self, place):
        self.now += 0.005
        return super().drawn(place)

    def monotonic(self):
        return self.now


@pytest.fixture
def clocked(monkeypatch):
    """A stream whose clock replaces that of the replay buffer."""
    stream = Clocked()
    monkeypatch.setattr("dpl.data.stream.time", stream)
    return stream


def test_the_rates_of_each_epoch_are_reported(replay, clocked):
    stream = replay(clocked, batches=5, reuse=4, capacity=1000)
    next(iter(stream))
    assert stream.rates is None, "the epoch is not finished"
    for _ in range(3):
        list(stream)
        assert stream.rates["produced"] == pytest.approx(1 / 0.005)
        assert stream.rates["waiting"] == pytest.approx(1), "this loop has nothing else to do"
    assert stream.rates["uses"] == pytest.approx(2, rel=0.1)


def test_an_optimiser_slower_than_the_stream_does_not_wait(replay, clocked):
    stream = replay(clocked, batches=5)
    for _ in stream:
        clocked.now += 1.0
    waited = 0.005 * stream.produced
    assert stream.rates["waiting"] == pytest.approx(waited / (4.0 + waited))
    assert stream.rates["waiting"] < 0.05

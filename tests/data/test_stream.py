"""Laws of the stream and the replay buffer: each load once, bounded reuse, faults of workers."""

import itertools
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch.utils.data import IterableDataset, get_worker_info

from dpl import Sample
from dpl.data.replay_buffer import ReplayBuffer
from dpl.data.solving.solve import LoadKey, solve_load
from dpl.data.stream import DrawnSample, OnlineSamples
from dpl.fem import Newton
from dpl.scene import stack

SEED = (0, 0)


class Numbers(IterableDataset):
    """A stream like `OnlineSamples` without mechanics; the modulus is the number of the load.

    Attributes:
        end: Number at which it ends; None: never.
        deadly: Number of the load that kills its worker.
        pause: Time per sample of each worker [s].
    """

    def __init__(self, end=None, *, deadly=None, pause=(), shape=(2, 3)):
        self.first, self.rank, self.world_size = 0, 0, 1
        self.offsets = {}
        self.end, self.deadly, self.pause, self.shape = end, deadly, pause, shape

    def __iter__(self):
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        turn = self.rank * workers + worker
        first = self.offsets.get(turn, self.first + turn)
        for place in itertools.count(first, workers * self.world_size):
            if self.end is not None and place >= self.end:
                return
            if place == self.deadly:
                os.kill(os.getpid(), signal.SIGKILL)
            if self.pause:
                time.sleep(self.pause[worker])
            yield self.drawn(place)

    def drawn(self, place):
        field = torch.full(self.shape, float(place), dtype=torch.float64)
        young = torch.tensor(float(place), dtype=torch.float64)
        return DrawnSample(Sample(field, -field, young), torch.tensor(place))


@pytest.fixture
def replay():
    """Return a function that builds replay buffers; they are closed."""
    made = []

    def replay(stream=None, **options):
        defaults = {
            "workers": 0,
            "batch_size": 8,
            "batches": 10,
            "new_per_round": 4,
            "reuse": 6,
            "capacity": 100,
        }
        made.append(ReplayBuffer(stream or Numbers(), **{**defaults, **options}))
        return made[-1]

    yield replay
    for one in made:
        one.close()


def children():
    return {child.pid for child in multiprocessing.active_children()}


def keys(batch):
    return {force.numpy().tobytes() for force in batch.force}


def places(batch):
    return batch.young.long().tolist()


def numbers(stream, count):
    return [int(one.number) for one in itertools.islice(stream, count)]


@pytest.fixture(scope="module")
def drawn(scene):
    """The forces of the first loads of the stream, as bytes."""
    return [f.numpy().tobytes() for f in scene.loads.sample(SEED, range(32)).force]


# ------------------------------------------------------------------ the stream


def test_the_stream_is_the_accepted_loads_in_order(scene, drawn):
    first = list(itertools.islice(OnlineSamples(scene, SEED), 6))
    assert [one.sample.force.numpy().tobytes() for one in first] == drawn[:6]
    assert [int(one.number) for one in first] == list(range(6))
    truth = solve_load(scene, LoadKey(SEED, 3))
    assert torch.equal(first[3].sample.displacement, torch.from_numpy(truth.displacement))


def test_the_stream_draws_its_own_moduli(make_scene):
    stream = OnlineSamples(make_scene(young=[1e6, 2e11]), SEED)
    young = torch.stack([one.sample.young for one in itertools.islice(stream, 6)])
    assert torch.equal(young, stream.scene.loads.sample(SEED, range(6)).young)
    assert len(young.unique()) == 6


def test_rejected_loads_do_not_enter_the_stream(scene, drawn, monkeypatch):
    def choosy(scene, job):
        return solve_load(scene, job)._replace(accepted=job.number % 3 == 1)

    monkeypatch.setattr("dpl.data.stream.solve_load", choosy)
    first = itertools.islice(OnlineSamples(scene, SEED), 3)
    assert [one.sample.force.numpy().tobytes() for one in first] == [drawn[1], drawn[4], drawn[7]]


@pytest.mark.parametrize("world_size", [2, 3])
def test_training_processes_solve_disjoint_loads_that_cover_the_stream(scene, world_size):
    seen = [
        numbers(OnlineSamples(scene, SEED, first=4, rank=k, world_size=world_size), 4)
        for k in range(world_size)
    ]
    assert sorted(itertools.chain(*seen)) == list(range(4, 4 + 4 * world_size))


def test_two_workers_share_a_stream_and_end_when_it_is_closed(scene, drawn, replay):
    before = children()
    options = {"new_per_round": 4, "batch_size": 256, "reuse": 128, "batches": 4}
    stream = replay(OnlineSamples(scene, SEED), workers=2, **options)
    seen = set().union(*[keys(batch) for batch in stream])
    started = children() - before
    assert len(started) == 2
    assert stream.produced == 16
    assert seen == set(drawn[:16]), "no load is left out and none is solved by both"
    next(iter(stream))  # the next epoch goes on with the same workers
    assert children() - before == started
    stream.close()
    assert not started & children()
    assert not any(Path(f"/proc/{pid}").exists() for pid in started)


# ------------------------------------------------------------------ epochs


def test_batches_are_samples_with_a_leading_batch_axis(replay):
    batch = next(iter(replay()))
    assert isinstance(batch, Sample)
    assert batch.force.shape == batch.displacement.shape == (8, 2, 3)
    assert batch.young.shape == (8,)
    assert torch.equal(batch.force[:, 0, 0], batch.young), "columns are drawn together"
    assert torch.equal(batch.displacement, -batch.force)


def test_nothing_starts_before_the_first_batch(replay):
    class Never(Numbers):
        def __iter__(self):
            raise AssertionError("started")

    stream = replay(Never())
    assert len(stream) == 10
    assert stream.produced == 0


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
    used = counted(stream, 300 if reuse > 1 else 60)
    assert used.max() <= reuse
    assert reuse > 1 or (used[:-5] == 1).all(), "none is lost"


@pytest.mark.parametrize("reuse", [2, 6, 50])
def test_samples_are_used_half_as_often_while_the_buffer_fills(replay, reuse):
    stream = replay(reuse=reuse, batches=1, capacity=10_000)
    for drawn in range(1, 200):
        next(iter(stream))
        assert drawn * 8 <= stream.produced * reuse / 2, "no more than they are good for"
        assert (stream.produced - 4) * reuse / 2 < drawn * 8, "none is taken before it is needed"


@pytest.mark.parametrize("reuse", [2, 6, 50])
def test_samples_are_used_reuse_times_on_average_once_the_buffer_is_full(replay, reuse):
    stream = replay(reuse=reuse, batches=1, capacity=64)
    while stream.produced <= 64:
        next(iter(stream))
    produced, used = stream.produced, 0
    for _ in range(100 * reuse):
        used += len(next(iter(stream)).young)
    assert used == pytest.approx((stream.produced - produced) * reuse, abs=4 * reuse + 8)


def test_no_sample_is_twice_in_a_batch_if_there_are_enough(replay):
    stream = replay(batches=1, new_per_round=8, reuse=4, capacity=64, batch_size=8)
    for _ in range(300):
        assert len(set(places(next(iter(stream))))) == 8


def test_a_batch_larger_than_the_buffer_holds_samples_more_than_once(replay):
    stream = replay(batches=1, new_per_round=4, reuse=12, capacity=4, batch_size=16)
    for _ in range(30):
        batch = next(iter(stream))
        assert len(batch.young) == 16
        assert len(set(places(batch))) <= 4


def test_the_oldest_samples_leave_a_full_buffer(replay):
    stream = replay(capacity=12, new_per_round=4, reuse=2, batches=1)
    for _ in range(50):
        batch = next(iter(stream))
        assert batch.young.min() >= stream.produced - 12
        assert batch.young.max() < stream.produced


def test_all_samples_of_the_buffer_are_drawn(replay):
    stream = replay(capacity=16, new_per_round=16, reuse=100, batch_size=100, batches=8)
    counts = torch.bincount(torch.cat([batch.young for batch in stream]).long(), minlength=16)
    assert counts.min() > 20  # 800 draws from 16


@pytest.mark.parametrize("reuse", [4, 50])
def test_batches_stay_mixed_however_long_it_runs(replay, reuse):
    """A batch holds old and new samples."""
    stream = replay(capacity=256, new_per_round=8, reuse=reuse, batch_size=32, batches=1)
    for _ in range(60 * reuse):
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


@pytest.mark.slow
def test_batches_do_not_depend_on_which_worker_is_faster(replay):
    streams = [replay(Numbers(pause=pause), workers=2) for pause in ([0.02, 0.0], [0.0, 0.02])]
    for _ in range(3):
        one, other = (torch.stack([batch.young for batch in stream]) for stream in streams)
        assert torch.equal(one, other)


def test_memory_does_not_grow_beyond_the_buffer(replay):
    shape = (100, 3)  # 5 kB a sample: 64 chunks of 64 are 20 MB
    stream = replay(
        Numbers(shape=shape), new_per_round=64, capacity=128, reuse=2, batch_size=64, batches=2
    )

    def resident():
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    for _ in stream:
        pass
    columns = [column.data_ptr() for column in stream._buffer.sample]
    for _ in range(20):
        list(stream)
    before = resident()
    for _ in range(100):
        for _ in stream:
            pass
    assert stream.produced > 6000
    assert resident() - before < 8, "MB; all that went through is 30 MB"
    assert [column.data_ptr() for column in stream._buffer.sample] == columns


def test_new_samples_do_not_change_earlier_batches(replay):
    stream = replay(capacity=8, new_per_round=8, reuse=1, batches=1)
    batch = next(iter(stream))
    before = batch.force.clone()
    for _ in range(5):
        next(iter(stream))
    assert torch.equal(batch.force, before)


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
    monkeypatch.setattr("dpl.data.replay_buffer.time", stream)
    return stream


def test_the_rates_of_each_epoch_are_reported(replay, clocked):
    stream = replay(clocked, batches=5, reuse=4, capacity=1000)
    for _ in range(3):
        list(stream)
        rates = stream.rates
        assert rates.produced == pytest.approx(1 / 0.005)
        assert 1.5 * rates.produced < rates.consumed < 2.7 * rates.produced  # reuse / 2
        assert rates.waiting == pytest.approx(1), "this loop has nothing else to do"
    assert stream.rates.uses == pytest.approx(2, rel=0.1)


def test_an_optimiser_slower_than_the_stream_does_not_wait(replay, clocked):
    stream = replay(clocked, batches=5)
    for _ in stream:
        clocked.now += 1.0
    waited = 0.005 * stream.produced
    assert stream.rates.waiting == pytest.approx(waited / (4.0 + waited))
    assert stream.rates.waiting < 0.05
    assert stream.rates.consumed == pytest.approx(4 * 8 / (4.0 + waited))


def test_an_unfinished_epoch_reports_no_rates(replay):
    stream = replay(batches=5)
    next(iter(stream))
    assert stream.rates is None


# ------------------------------------------------------------------ loads that hang


@dataclass(frozen=True)
class Hanging(Newton):
    """Newton solver that hangs on some loads."""

    def iterate(self, load, **options):
        if hangs(load.force[0]):
            assert signal.getitimer(signal.ITIMER_REAL)[0] > 0
            signal.setitimer(signal.ITIMER_REAL, 1e-3)  # the limit is over at once
            while True:  # a signal just before a single long sleep would not interrupt it
                time.sleep(0.01)
        return super().iterate(load, **options)


def hangs(force):
    """Return True for some loads; the number of loaded nodes does not depend on round-off."""
    return int((force != 0).any(dim=-1).sum()) % 4 == 3


@pytest.fixture(scope="module")
def hanging(make_scene):
    return make_scene(newton=Hanging)


@pytest.fixture(scope="module")
def good(scene):
    """The numbers of the loads that do not hang."""
    return [k for k, f in enumerate(scene.loads.sample(SEED, range(32)).force) if not hangs(f)]


def test_a_load_that_hangs_is_timed_out_in_a_worker_and_left_out(hanging, good, monkeypatch):
    """This process takes the role of a worker."""
    monkeypatch.setattr(
        "dpl.data.stream.get_worker_info", lambda: SimpleNamespace(id=0, num_workers=1)
    )
    before = signal.getsignal(signal.SIGALRM)
    assert good[:6] != list(range(6)), "one of the first hangs"
    assert numbers(OnlineSamples(hanging, SEED, timeout=240.0), 6) == good[:6]
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


@pytest.mark.slow
def test_a_load_that_hangs_is_timed_out_in_a_real_worker(hanging, good, replay):
    options = {"workers": 1, "new_per_round": 2, "batch_size": 2, "reuse": 1, "batches": 4}
    stream = replay(OnlineSamples(hanging, SEED, timeout=240.0), **options)
    seen = set().union(*[keys(batch) for batch in stream])
    forces = hanging.loads.sample(SEED, good[:8]).force
    assert seen == {force.numpy().tobytes() for force in forces}


# ------------------------------------------------------------------ workers that die


@pytest.mark.slow
def test_a_killed_worker_is_replaced_and_the_stream_goes_on(replay):
    before = children()
    stream = replay(Numbers(pause=[0.05, 0.05]), workers=2, reuse=1, new_per_round=2, batches=2)
    seen = [place for batch in stream for place in places(batch)]
    started = children() - before
    for victim in sorted(started)[:1]:
        os.kill(victim, signal.SIGKILL)
    seen += [place for _ in range(4) for batch in stream for place in places(batch)]
    assert len(seen) == len(set(seen)) == 5 * 16, "none twice, none missing in a batch"
    assert len(children() - before) == 2
    assert not (children() - before) & started


def test_the_loads_of_a_dead_worker_are_solved_again(replay, monkeypatch):
    """Also if another worker is ahead."""
    source = Numbers()
    stream = replay(source, reuse=1, new_per_round=2, batch_size=2, batches=1)

    def two():  # workers, of which the second dies in its first chunk
        drawn = [source.drawn(0), source.drawn(2)]
        yield DrawnSample(stack([d.sample for d in drawn]), torch.stack([d.number for d in drawn]))
        raise RuntimeError("DataLoader worker (pid 1) is killed by signal: Killed.")

    begun = []

    def start():
        begun.append(dict(source.offsets))
        stream._stream = iter([]) if len(begun) > 1 else two()

    stream.workers = 2
    monkeypatch.setattr(stream, "_start", start)
    assert sorted(places(next(iter(stream)))) == [0, 2]
    assert next(iter(stream), None) is None
    assert begun == [{}, {0: 4}], "the second worker begins where it began, at 1"


@pytest.mark.slow
def test_a_worker_that_dies_during_a_training_step_is_replaced(replay):
    """No exception may be raised in the middle of a step."""
    before = children()
    stream = replay(Numbers(), workers=2, reuse=1, new_per_round=2, batches=2)
    seen = [place for batch in stream for place in places(batch)]
    os.kill(min(children() - before), signal.SIGKILL)
    end = time.monotonic() + 1
    while time.monotonic() < end:  # a step
        torch.randn(50, 50) @ torch.randn(50, 50)
    seen += [place for batch in stream for place in places(batch)]
    assert len(seen) == len(set(seen))


@pytest.mark.slow
@pytest.mark.parametrize("deadly", [1, 5])
def test_a_load_that_always_kills_its_worker_is_skipped(replay, deadly):
    stream = replay(Numbers(deadly=deadly), workers=1, reuse=1, new_per_round=8, batches=4)
    seen = [place for batch in stream for place in places(batch)]
    assert len(seen) == len(set(seen)) == 32
    assert deadly not in seen


@pytest.mark.slow
def test_workers_that_all_die_end_training_with_an_error(replay):
    with pytest.raises(RuntimeError, match="worker"):
        next(iter(replay(Deadly(), workers=1)))


class Deadly(Numbers):
    """A stream each of whose loads kills its worker."""

    def drawn(self, place):
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_replaced_worker_solves_loads_of_its_own_rank(replay):
    """Rank 0 of 2 solves the even loads."""
    source = Numbers()
    source.world_size = 2
    stream = replay(source, reuse=1, new_per_round=3, batch_size=3, batches=2)
    seen = [place for batch in stream for place in places(batch)]

    def dead():
        raise RuntimeError("DataLoader worker (pid 1) is killed by signal: Killed.")
        yield

    stream._stream = dead()
    seen += [place for batch in stream for place in places(batch)]
    assert [place % 2 for place in seen] == [0] * 12


class Faulty(Numbers):
    """A stream each of whose loads raises an error.

    Attributes:
        error: The error.
    """

    def __init__(self, error):
        super().__init__()
        self.error = error

    def drawn(self, place):
        raise self.error


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("error", [RuntimeError, OSError])
def test_an_error_of_the_stream_itself_is_raised_at_once(replay, workers, error, monkeypatch):
    """Workers report it, so that they are not dead."""
    stream, started = replay(Faulty(error("a fault of ours")), workers=workers), []
    start = stream._start
    monkeypatch.setattr(stream, "_start", lambda: started.append(1) or start())
    with pytest.raises(error, match="a fault of ours"):
        next(iter(stream))
    assert len(started) == 1
    assert stream.stream.offsets == {}, "no load is skipped"


def test_a_closed_stream_can_be_closed_again(replay):
    stream = replay()
    next(iter(stream))
    stream.close()
    stream.close()
    assert len(set(places(next(iter(stream))))) == 8, "it begins again when it is requested"


# ------------------------------------------------------------------ workers end with the parent

PARENT = textwrap.dedent(
    """
    import json, multiprocessing, sys, time
    sys.path.insert(0, sys.argv[1])
    from test_stream import Busy
    from dpl.data.replay_buffer import ReplayBuffer

    if __name__ == "__main__":
        stream = ReplayBuffer(
            Busy(), workers=2, batch_size=2, batches=9, new_per_round=2, reuse=1, capacity=64
        )
        batches = iter(stream)
        next(batches), next(batches)
        print(json.dumps([child.pid for child in multiprocessing.active_children()]), flush=True)
        sys.stdin.readline()
        print(len(next(batches).young), flush=True)
        time.sleep(1000)
    """
)


class Busy(Numbers):
    """A stream that computes without end from load 20 on."""

    def drawn(self, place):
        end = time.monotonic() + (1000 if place >= 20 else 0)
        while time.monotonic() < end:
            torch.randn(300, 300) @ torch.randn(300, 300)
        return super().drawn(place)


def alive(pids):
    found = []
    for pid in pids:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue
        if state != "Z":
            found.append(pid)
    return found


@pytest.mark.slow
def test_workers_ignore_ctrl_c_and_die_with_their_parent(environment, tmp_path):
    (tmp_path / "parent.py").write_text(PARENT)
    parent = subprocess.Popen(
        [sys.executable, "parent.py", str(Path(__file__).parent)],
        cwd=tmp_path,
        env=environment(),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        line = parent.stdout.readline()
        assert line, parent.stderr.read()
        workers = json.loads(line)
        assert len(workers) == 2
        for pid in workers:
            os.kill(pid, signal.SIGINT)
        time.sleep(0.5)
        assert alive(workers) == workers
        parent.stdin.write("\n")
        parent.stdin.flush()
        assert parent.stdout.readline() == "2\n", "the stream goes on"
        parent.kill()
        parent.wait()
        end = time.monotonic() + 240
        while alive(workers) and time.monotonic() < end:
            time.sleep(0.05)
        assert not alive(workers)
    finally:
        parent.kill()
        parent.communicate()

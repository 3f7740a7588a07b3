"""Endless stream of training samples that worker processes solve while a network trains."""

import itertools
import sys
import time
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import torch

from dpl.data.samples import transform
from dpl.data.solving.background import Background, StopFlag
from dpl.data.solving.solve import LoadKey, SolvedLoad
from dpl.data.solving.worker_pool import solve_loads
from dpl.data.sources import MAX_COUNT, Source
from dpl.fem.symmetry import NO_SYMMETRIES, SymmetryGroup
from dpl.scene import Sample, Scene
from dpl.system.checks import check_range
from dpl.system.memory import machine, refuse_beyond
from dpl.system.threads import leave_cores

AHEAD = 8  # solved loads, for each worker, that wait to be used
MAX_EARLY = 256  # loads solved before a load of a smaller number, after which that one is left out


@dataclass(eq=False)
class Stream(Source):
    """Samples that worker processes solve while the network trains, kept in a `ReplayBuffer`.

    Attributes:
        batches: Batches in an epoch.
        new_per_round: New samples after which batches are drawn again.
        reuse: Maximum number of uses of a sample.
        capacity: Number of samples that the replay buffer keeps.
    """

    _: KW_ONLY
    batches: int = 16
    new_per_round: int = 8
    reuse: int = 50
    capacity: int = 4096
    _samples: Generator[tuple[int, Sample], None, None] | None = field(default=None, init=False)
    _replay: "ReplayBuffer | None" = field(default=None, init=False)
    _processes: int = field(default=1, init=False)
    _workers: int = field(default=0, init=False)
    _first: int = field(default=0, init=False)  # number of loads of the run that this one resumes

    def __post_init__(self) -> None:
        counts = {name: getattr(self, name) for name in ("batches", "new_per_round", "reuse")}
        check_range(1, MAX_COUNT, **counts)
        if self.capacity < self.new_per_round:
            raise ValueError(
                f"capacity = {self.capacity} must be at least new_per_round = {self.new_per_round}"
            )

    def check(self, scene: Scene, batch_size: int) -> None:
        """Check that the buffer can give a batch and fits into the memory of the machine."""
        super().check(scene, batch_size)
        if self.capacity * self.reuse < batch_size:
            raise ValueError(
                f"capacity * reuse = {self.capacity} * {self.reuse} must be at least batch_size = "
                f"{batch_size}; take a larger data.train.capacity or data.train.reuse"
            )
        needed = self.capacity * 2 * 8 * scene.problem.points.numel() / 1e9
        remedy = "take a smaller data.train.capacity"
        refuse_beyond(needed, machine(), f"{self.capacity} samples", remedy)

    @property
    def rates(self) -> Mapping[str, float] | None:  # type: ignore[override]
        """Rates of the stream in the last epoch, see `ReplayBuffer`."""
        return self._replay.rates if self._replay is not None else None

    def loader(self, data: Any) -> "ReplayBuffer":
        """Return the stream; training is limited to the cores that its workers leave."""
        leave_cores(data.workers)
        self.close()  # the stream of an earlier training
        rank, self._processes = data.rank_and_world_size
        self._workers = data.workers
        self._samples = accepted_samples(
            data.scene,
            data.store.stream("train"),
            self._first + rank,
            self._processes,
            workers=self._workers,
            timeout=data.dataset.timeout,
        )
        sizes = data.batch_size, data.shuffle_seed, data.group
        self._replay = ReplayBuffer(self._samples, self, *sizes)
        return self._replay

    def close(self) -> None:
        """Stop the workers."""
        if self._samples is not None:
            self._samples.close()

    def state_dict(self) -> dict[str, Any]:
        """Return the number of loads that all training processes have taken.

        Other processes have taken as many samples, but may have met more rejected loads. The number
        of loads that this process has taken beyond its samples is therefore added once more.
        """
        taken = self._first
        if self._replay is not None:
            taken = max(taken, self._replay.next_index)
            if self._processes > 1:
                beyond = taken - self._first - self._processes * self._replay.produced
                taken += self._processes * max(1, self._workers) + max(0, beyond)
        return {"next_index": taken}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue a stream where it was left; no load is drawn twice."""
        self._first = state["next_index"]


def accepted_samples(
    scene: Scene,
    seed: tuple[int, int],
    first: int = 0,
    step: int = 1,
    *,
    workers: int = 0,
    timeout: float | None = None,
) -> Generator[tuple[int, Sample], None, None]:
    """Yield numbers and samples (N, D) of the accepted loads of an endless stream in their order.

    Its loads have the numbers `first`, `first + step` and so on. Worker processes, see
    `solve_loads`, solve loads ahead of their use, and end when the generator is closed. Without
    workers a load is solved when it is needed. Nothing is solved before the first sample is needed.
    """
    numbers = range(first, sys.maxsize, step)

    def solve(stop: StopFlag) -> Generator[SolvedLoad, None, None]:
        jobs = (LoadKey(seed, number) for number in numbers)
        return solve_loads(scene, jobs, workers=workers, timeout=timeout, stop=stop)

    early: dict[int, SolvedLoad] = {}
    with closing(Background(solve, thread=workers > 0, ahead=AHEAD * workers)) as background:
        for number in numbers:
            while number not in early and len(early) < MAX_EARLY:
                if (solved := background.get()) is None:  # it has been stopped
                    return
                if solved.job.number >= number:
                    early[solved.job.number] = solved
            found = early.pop(number, None)
            if found is not None and found.accepted:
                point = torch.from_numpy(found.point)[None]
                force, displacement = map(torch.from_numpy, (found.force, found.displacement))
                young = scene.loads.young_at(point)[0]
                parameters = scene.loads.parameters_at(point)[0]
                yield number, Sample(force, displacement, young, parameters)


class ReplayBuffer:
    """Batches from the last samples of a stream, each used a bounded number of times.

    In each round, `new_per_round` new samples enter a buffer, where they replace the oldest ones
    once it is full. Batches are then drawn from the samples that have been used less than `reuse`
    times. Once the buffer is full, a sample is used `reuse` times on average; while it fills, half
    as often. Batches are therefore a function of the stream and not of relative speeds. One pass
    is an epoch; the stream continues from epoch to epoch.

    Attributes:
        produced: Number of samples taken from the stream so far.
        next_index: Upper bound of the numbers of these loads, plus one.
        rates: `produced` samples per second of the last epoch, fraction of its time `waiting` for
            samples, mean number of `uses` of a sample so far, samples in the `buffer`; None before
            its end.
    """

    def __init__(
        self,
        samples: Iterable[tuple[int, Sample]],
        sizes: Stream,
        batch_size: int,
        seed: int = 0,
        group: SymmetryGroup = NO_SYMMETRIES,
    ) -> None:
        """Start with an empty buffer, to be filled with samples of loads of ascending numbers.

        `sizes` are those of the buffer, of its rounds and of an epoch. The seed decides about the
        choice of samples and of images: with symmetries of the body, each use is that of a random
        image.
        """
        self.batch_size, self.group = batch_size, group
        self.produced = self.next_index = 0
        self.rates: dict[str, float] | None = None
        self._sizes = sizes
        self._samples: list[Sample] = []
        self._uses_left = torch.zeros(sizes.capacity, dtype=torch.int64)
        self._batches = self._draw(iter(samples))
        self._generator = torch.Generator().manual_seed(seed)
        self._used = 0
        self._waited = 0.0

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return self._sizes.batches

    def __iter__(self) -> Iterator[Sample]:
        """Yield the batches of one epoch."""
        start, produced, waited = time.monotonic(), self.produced, self._waited
        for k, batch in enumerate(itertools.islice(self._batches, len(self)), 1):
            if k == len(self):  # before the last batch, after which no code of this loop runs
                seconds = max(time.monotonic() - start, 1e-9)
                self.rates = {
                    "produced": (self.produced - produced) / seconds,
                    "waiting": (self._waited - waited) / seconds,
                    "uses": self._used / max(self.produced, 1),
                    "buffer": float(len(self._samples)),
                }
            yield batch

    def _draw(self, samples: Iterator[tuple[int, Sample]]) -> Iterator[Sample]:
        """Yield batches without end."""
        sizes = self._sizes
        budget = 0.0  # uses that the samples so far allow
        while True:
            start = time.monotonic()
            new = list(itertools.islice(samples, sizes.new_per_round))
            self._waited += time.monotonic() - start
            if not new:  # the end of a finite stream
                return
            self.produced += len(new)
            self.next_index = new[-1][0] + 1
            is_full = len(self._samples) == sizes.capacity
            budget += len(new) * (sizes.reuse if is_full else max(1.0, sizes.reuse / 2))
            for number, (_, sample) in enumerate(new, self.produced - len(new)):
                place = number % sizes.capacity
                self._samples[place : place + 1] = [sample]  # appends while the buffer fills
                self._uses_left[place] = sizes.reuse
            while budget >= self.batch_size and self._uses_left.sum() >= self.batch_size:
                budget -= self.batch_size
                self._used += self.batch_size
                usable = self._uses_left.nonzero()[:, 0]
                if len(usable) < self.batch_size:  # some more than once
                    usable = torch.repeat_interleave(usable, self._uses_left[usable])
                order = torch.randperm(len(usable), generator=self._generator)
                chosen = usable[order[: self.batch_size]]
                self._uses_left -= torch.bincount(chosen, minlength=len(self._uses_left))
                singles = (self._samples[place] for place in chosen.tolist())
                batch = Sample(*map(torch.stack, zip(*singles, strict=True)))
                if self.group:
                    shape = (self.batch_size,)
                    which = torch.randint(len(self.group), shape, generator=self._generator)
                    batch = transform(batch, self.group, which)
                yield batch

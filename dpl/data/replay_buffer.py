"""Replay buffer of samples that worker processes solve while the network trains."""

import itertools
import time
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, field

import torch

from dpl.data.samples import transform
from dpl.data.stream import SampleStream
from dpl.fem.symmetry import NO_SYMMETRIES, SymmetryGroup
from dpl.scene import Sample, stack


@dataclass(eq=False)
class ReplayBuffer:
    """Batches from the last samples of a stream, each used a bounded number of times.

    In each round, `new_per_round` new samples enter a buffer, where they replace the oldest ones
    once it is full. Batches are then drawn from the samples that have been used less than `reuse`
    times. Once the buffer is full, a sample is used `reuse` times on average; while it fills, half
    as often. Batches are therefore a function of the stream and not of relative speeds. One pass
    is an epoch of `batches` batches; the stream continues from epoch to epoch.

    Attributes:
        stream: Source of the samples.
        batch_size: Samples in a batch.
        batches, new_per_round, reuse, capacity: See `dpl.data.Stream`.
        seed: Seed of the choice of samples and images.
        group: Symmetries of the body, identity first: each use is that of a random image.
        produced: Number of samples taken from the stream so far.
        next_index: Upper bound of the numbers of these loads, plus one.
        rates: `produced` samples per second of the last epoch, fraction of its time `waiting` for
            samples, mean number of `uses` of a sample so far, samples in the `buffer`; None before
            its end.
    """

    stream: SampleStream
    _: KW_ONLY
    batch_size: int
    batches: int
    new_per_round: int
    reuse: int
    capacity: int
    seed: int = 0
    group: SymmetryGroup = NO_SYMMETRIES
    produced: int = field(default=0, init=False)
    next_index: int = field(default=0, init=False)
    rates: dict[str, float] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._samples: list[Sample] = []
        self._uses_left = torch.zeros(self.capacity, dtype=torch.int64)
        self._batches = self._draw()
        self._generator = torch.Generator().manual_seed(self.seed)
        self._used = 0
        self._waited = 0.0

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return self.batches

    def __iter__(self) -> Iterator[Sample]:
        """Yield the batches of one epoch."""
        start, produced, waited = time.monotonic(), self.produced, self._waited
        for k, batch in enumerate(itertools.islice(self._batches, self.batches), 1):
            if k == self.batches:  # before the last batch, after which no code of this loop runs
                seconds = max(time.monotonic() - start, 1e-9)
                self.rates = {
                    "produced": (self.produced - produced) / seconds,
                    "waiting": (self._waited - waited) / seconds,
                    "uses": self._used / max(self.produced, 1),
                    "buffer": float(len(self._samples)),
                }
            yield batch

    @property
    def taken(self) -> int:
        """Number of loads that all training processes have taken.

        Other processes have taken as many samples, but may have met more rejected loads. The number
        of loads that this process has taken beyond its samples is therefore added once more.
        """
        first, processes = self.stream.first, self.stream.world_size
        taken = max(first, self.next_index)
        if processes > 1:
            beyond = taken - first - processes * self.produced
            taken += processes * max(1, self.stream.workers) + max(0, beyond)
        return taken

    def _draw(self) -> Iterator[Sample]:
        """Yield batches without end."""
        samples = iter(self.stream)
        budget = 0.0  # uses that the samples so far allow
        while new := self._next_samples(samples):
            is_full = len(self._samples) == self.capacity
            budget += len(new) * (self.reuse if is_full else max(1.0, self.reuse / 2))
            for number, sample in enumerate(new, self.produced - len(new)):
                place = number % self.capacity
                self._samples[place : place + 1] = [sample]  # appends while the buffer fills
                self._uses_left[place] = self.reuse
            while budget >= self.batch_size and self._uses_left.sum() >= self.batch_size:
                budget -= self.batch_size
                self._used += self.batch_size
                batch = stack([self._samples[place] for place in self._choose()])
                if self.group:
                    shape = (self.batch_size,)
                    which = torch.randint(len(self.group), shape, generator=self._generator)
                    batch = transform(batch, self.group, which)
                yield batch

    def _choose(self) -> list[int]:
        """Return the places of samples for a batch, distinct if there are enough."""
        usable = self._uses_left.nonzero()[:, 0]
        if len(usable) < self.batch_size:
            usable = torch.repeat_interleave(usable, self._uses_left[usable])
        chosen = usable[torch.randperm(len(usable), generator=self._generator)[: self.batch_size]]
        self._uses_left -= torch.bincount(chosen, minlength=self.capacity)
        return list(chosen.tolist())

    def _next_samples(self, samples: Iterator[tuple[int, Sample]]) -> list[Sample]:
        """Return the samples of a round; fewer at the end of a finite stream."""
        start = time.monotonic()
        drawn = list(itertools.islice(samples, self.new_per_round))
        self._waited += time.monotonic() - start
        self.produced += len(drawn)
        self.next_index = drawn[-1][0] + 1 if drawn else self.next_index
        return [sample for _, sample in drawn]

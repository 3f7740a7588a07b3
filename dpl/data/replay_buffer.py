"""Replay buffer of samples that worker processes solve while the network trains."""

import itertools
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from dpl.data.solving.worker_pool import MAX_CONSECUTIVE_CRASHES, MAX_RETRIES
from dpl.data.stream import DrawnSample, OnlineSamples
from dpl.fem.symmetry import NO_SYMMETRIES, SymmetryGroup
from dpl.scene import Sample, stack
from dpl.system.processes import block_signals, spawn_context


class StreamRates(NamedTuple):
    """Rates of production and use of samples in one epoch.

    Attributes:
        produced, consumed: Samples per second.
        waiting: Fraction of the time in which training waited for samples.
        uses: Mean number of uses of the samples produced so far.
        buffer: Number of samples in the buffer.
    """

    produced: float
    consumed: float
    waiting: float
    uses: float
    buffer: int


@dataclass(eq=False)
class ReplayBuffer:
    """Batches from the last samples of a stream, each used a bounded number of times.

    In each round, `new_per_round` new samples enter a buffer, where they replace the oldest ones
    once it is full. Batches are then drawn from the samples that have been used less than `reuse`
    times. Once the buffer is full, a sample is used `reuse` times on average; while it fills, half
    as often. Batches are therefore a function of the stream and not of relative speeds. One pass
    is an epoch of `batches` batches; the stream continues from epoch to epoch.

    Workers start in the first pass. A worker that dies is replaced, and the loads that it was
    solving are solved again.

    Attributes:
        stream: Source of the samples.
        workers: Number of processes that solve; 0: solve in this process, between the steps.
        batch_size: Samples in a batch.
        batches: Batches in a pass.
        new_per_round: New samples per round.
        reuse: Maximum number of uses of a sample.
        capacity: Number of samples that the buffer keeps.
        seed: Seed of the choice of samples and images.
        group: Symmetries of the body, identity first: each use is that of a random image.
        errors: Returns the surrogate's errors on the last batch, (B,); called only if the stream
            has hard examples.
        report: Called with the rates at the end of each pass.
        produced: Number of samples taken from the stream so far.
        next_index: Upper bound of the numbers of these loads, plus one.
        rates: Rates of the last epoch; None before its end.
    """

    stream: OnlineSamples
    _: KW_ONLY
    workers: int
    batch_size: int
    batches: int
    new_per_round: int
    reuse: int
    capacity: int
    seed: int = 0
    group: SymmetryGroup = NO_SYMMETRIES
    errors: Callable[[], Tensor | None] = lambda: None
    report: Callable[[StreamRates], None] = lambda rates: None
    produced: int = field(default=0, init=False)
    next_index: int = field(default=0, init=False)
    rates: StreamRates | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        """Start without samples and without workers."""
        self._buffer = _Buffer(self.capacity, self.reuse)
        self._stream: Any = None
        self._endless: Iterator[Sample] | None = None
        self._generator = torch.Generator().manual_seed(self.seed)
        self._used = self._restarts = 0
        self._waited = 0.0

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return self.batches

    def __iter__(self) -> Iterator[Sample]:
        """Yield the batches of one epoch."""
        if self._endless is None:
            self._start()
            self._endless = self._draw()
        start, produced, used, waited = time.monotonic(), self.produced, self._used, self._waited
        for k, batch in enumerate(itertools.islice(self._endless, self.batches), 1):
            if k == self.batches:  # before the last batch, after which no code of this loop runs
                used += self.batch_size if k > 1 else 0  # the last batch is not used yet
                seconds = max(time.monotonic() - start, 1e-9)
                self.rates = StreamRates(
                    produced=(self.produced - produced) / seconds,
                    consumed=(self._used - used) / seconds,
                    waiting=(self._waited - waited) / seconds,
                    uses=self._used / max(self.produced, 1),
                    buffer=self._buffer.size,
                )
                self.report(self.rates)
            yield batch

    def _start(self) -> None:
        """Start the workers."""
        loader = DataLoader(
            self.stream,
            # single samples after a crash: the samples that precede a fatal load are not lost
            batch_size=1 if self._restarts else self.new_per_round,
            num_workers=self.workers,
            collate_fn=_collate,
            multiprocessing_context=spawn_context() if self.workers else None,
            worker_init_fn=_ignore_interrupts,
            generator=torch.Generator(),  # the random numbers of the training stay untouched
        )
        before = signal.getsignal(signal.SIGCHLD)
        with block_signals(signal.SIGINT):
            self._stream = iter(loader)
        if threading.current_thread() is threading.main_thread():
            # torch's handler raises at any point of the training when a worker dies;
            # `_next_samples` detects dead workers
            signal.signal(signal.SIGCHLD, before if before is not None else signal.SIG_DFL)

    def _draw(self) -> Iterator[Sample]:
        """Yield batches without end."""
        first, stride = self.stream.first, max(1, self.workers) * self.stream.world_size
        budget = 0.0  # uses that the samples so far allow
        while (new := self._next_samples()) is not None:
            self.produced += len(new.number)
            self.next_index = max(self.next_index, int(new.number.max()) + 1)
            for number in new.number.tolist():
                self.stream.offsets[(number - first) % stride] = number + stride
            uses = self.reuse if self._buffer.size == self.capacity else max(1.0, self.reuse / 2)
            budget += len(new.number) * uses
            self._buffer.put(new)
            while budget >= self.batch_size and self._buffer.uses_left >= self.batch_size:
                budget -= self.batch_size
                chosen = self._buffer.choose(self.batch_size, self._generator)
                self._used += self.batch_size
                batch = Sample(*(column[chosen] for column in self._buffer.sample))
                if self.group:
                    shape = (self.batch_size,)
                    which = torch.randint(len(self.group), shape, generator=self._generator)
                    batch = transform(batch, self.group, which)
                yield batch
                if self.stream.hard_examples is not None:
                    self._buffer.set_errors(chosen, self.errors())
                    self.stream.hard_examples.update(self._buffer.hardest_points())

    def _next_samples(self) -> DrawnSample | None:
        """Return new samples; None at the end of a finite stream. Replace dead workers."""
        start = time.monotonic()
        try:
            new = next(self._stream, None)
            self._restarts = 0
            return new
        except (RuntimeError, OSError, EOFError) as error:  # raised where a worker has died
            self._restarts += 1
            died = str(error).startswith("DataLoader worker (pid")
            if self.workers and not isinstance(error, RuntimeError):
                died = not str(error).startswith("Caught")  # the worker reports its own error
            if not died or self._restarts > MAX_CONSECUTIVE_CRASHES:
                raise
            if self._restarts % MAX_RETRIES == 0:
                self._skip_loads()
            self._start()
            return self._next_samples()
        finally:
            self._waited += time.monotonic() - start

    def _skip_loads(self) -> None:
        """Skip the next load of each worker of this process: one of them kills its worker."""
        source, first = self.stream, self.stream.rank * self.workers
        for index in range(first, first + self.workers):
            next_load = source.offsets.get(index, source.first + index)
            source.offsets[index] = next_load + self.workers * source.world_size

    def close(self) -> None:
        """Stop the workers."""
        self._endless = self._stream = None


class _Buffer:
    """The last samples of a stream, each with its last error and the number of uses left."""

    def __init__(self, capacity: int, reuse: int) -> None:
        self._capacity = capacity
        self._reuse = reuse
        self._count = 0
        self._uses_left = torch.zeros(capacity, dtype=torch.int64)
        self._error = torch.zeros(capacity, dtype=torch.float64)
        self._point = torch.zeros(capacity, 0, dtype=torch.float64)
        self.sample = Sample(*(torch.zeros(0) for _ in Sample._fields))

    @property
    def size(self) -> int:
        """Number of samples."""
        return min(self._count, self._capacity)

    @property
    def uses_left(self) -> int:
        """Total number of uses left."""
        return int(self._uses_left.sum())

    def put(self, new: DrawnSample) -> None:
        """Replace the oldest samples by new ones."""
        if not self._count:  # the system provides memory when it is first written
            self.sample = Sample(*(c.new_empty(self._capacity, *c.shape[1:]) for c in new.sample))
            self._point = new.point.new_zeros(self._capacity, new.point.shape[1])
        rows = torch.arange(self._count, self._count + len(new.number)) % self._capacity
        for column, values in zip(self.sample, new.sample, strict=True):
            column[rows] = values
        self._uses_left[rows] = self._reuse
        self._error[rows] = 0.0
        self._point[rows] = new.point
        self._count += len(new.number)

    def choose(self, count: int, generator: torch.Generator) -> Tensor:
        """Return rows of samples for a batch, distinct if there are enough, (B,)."""
        usable = self._uses_left.nonzero()[:, 0]
        if len(usable) < count:
            usable = torch.repeat_interleave(usable, self._uses_left[usable])
        chosen = usable[torch.randperm(len(usable), generator=generator)[:count]]
        self._uses_left -= torch.bincount(chosen, minlength=self._capacity)
        return chosen

    def set_errors(self, chosen: Tensor, errors: Tensor | None) -> None:
        """Store the surrogate's errors on a batch."""
        if errors is not None and len(errors) == len(chosen):
            self._error[chosen] = errors.double().cpu()

    def hardest_points(self) -> Tensor:
        """Return the points of a tenth of the samples with errors, largest errors first, (H, d)."""
        count = int(np.ceil(0.1 * int(self._error.count_nonzero())))
        return self._point[self._error.argsort(descending=True)[:count]]


def transform(batch: Sample, group: SymmetryGroup, which: Tensor) -> Sample:
    """Return samples transformed by symmetries of the body, `which` of them for each, (B,)."""
    force, displacement = (group.images(field, which) for field in batch[:2])
    return batch._replace(force=force, displacement=displacement)


def _ignore_interrupts(worker: int) -> None:
    """Make a worker ignore Ctrl-C, which is handled by its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _collate(drawn: list[DrawnSample]) -> DrawnSample:
    return DrawnSample(
        stack([one.sample for one in drawn]),
        torch.stack([one.number for one in drawn]),
        torch.stack([one.point for one in drawn]),
    )

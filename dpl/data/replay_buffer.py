"""A replay buffer of samples that worker processes solve while the network trains."""

import itertools
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from dpl.data.solving.worker_pool import MAX_CONSECUTIVE_CRASHES, MAX_RETRIES
from dpl.data.stream import DrawnSample, OnlineSamples
from dpl.fem.symmetry import Symmetry, images
from dpl.scene import Sample, stack
from dpl.system.processes import block_signals, spawn_context


class StreamRates(NamedTuple):
    """How fast an epoch's samples were made and used.

    Attributes:
        produced, consumed: Samples a second.
        waiting: Part of the time in which the optimiser had nothing to do.
        uses: How often the samples made so far have been used, on average.
        buffer: Samples kept.
    """

    produced: float
    consumed: float
    waiting: float
    uses: float
    buffer: int


class ReplayBuffer:
    """Batches from a stream and from what it has given so far: a slow solver, a busy optimiser.

    Every `fresh` new samples enter a buffer (the oldest leave a full one), and batches are drawn
    from those in it that have been used less than `reuse` times: once it is full, as many batches
    as use each sample `reuse` times on average; while it fills, half as many. So no sample is used
    more than `reuse` times, and batches do not depend on who was faster. One pass is an epoch of
    `batches`; the stream goes on from epoch to epoch.

    A worker that dies is replaced; what it was solving is drawn anew.

    Attributes:
        produced: Samples taken from the stream so far.
        following: A number above all loads taken from the stream so far.
        rates: Of the last epoch.
    """

    def __init__(
        self,
        stream: OnlineSamples,
        *,
        workers: int,
        batch_size: int,
        batches: int,
        fresh: int,
        reuse: int,
        capacity: int,
        group: Sequence[Symmetry] = (),
        errors: Callable[[], Tensor | None] = lambda: None,
        report: Callable[[StreamRates], None] = lambda rates: None,
    ) -> None:
        """Keep the arguments, see the class; nothing starts before the first pass.

        Args:
            stream: What to draw from.
            workers: Processes that solve; 0: this one, between the steps.
            batch_size: Samples in a batch.
            batches: Batches in a pass.
            fresh: New samples after which batches are drawn again.
            reuse: How often a sample is used at most.
            capacity: Samples kept.
            group: Symmetries of the body, identity first: each use is that of a random image.
            errors: Gives the errors on the last batch, (B,), if the stream wants to know where the
                surrogate is worst.
            report: Is told the rates at the end of each pass.
        """
        self.produced = self.following = 0
        self.rates: StreamRates | None = None
        self._source, self._workers, self._group = stream, workers, group
        self._batches, self._batch_size = batches, batch_size
        self._fresh, self._reuse = fresh, reuse
        self._errors, self._report = errors, report
        self._buffer = _Buffer(capacity, reuse)
        self._stream: Any = None
        self._endless: Iterator[Sample] | None = None
        self._generator = torch.Generator().manual_seed(0)
        self._used, self._waited, self._restarts = 0, 0.0, 0

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return self._batches

    def __iter__(self) -> Iterator[Sample]:
        """Yield one epoch."""
        if self._endless is None:
            self._start()
            self._endless = self._draw()
        begin, produced, used, waited = time.monotonic(), self.produced, self._used, self._waited
        for k, batch in enumerate(itertools.islice(self._endless, self._batches), 1):
            if k == self._batches:  # before the last batch: nobody may ask for one more
                used += self._batch_size if k > 1 else 0  # which is not used yet
                seconds = max(time.monotonic() - begin, 1e-9)
                self.rates = StreamRates(
                    produced=(self.produced - produced) / seconds,
                    consumed=(self._used - used) / seconds,
                    waiting=(self._waited - waited) / seconds,
                    uses=self._used / max(self.produced, 1),
                    buffer=self._buffer.size,
                )
                self._report(self.rates)
            yield batch

    def _start(self) -> None:
        loader = DataLoader(
            self._source,
            # once a worker has died, one by one: none is lost with those that come after it
            batch_size=1 if self._restarts else self._fresh,
            num_workers=self._workers,
            collate_fn=_batch,
            multiprocessing_context=spawn_context() if self._workers else None,
            worker_init_fn=_begin,
            generator=torch.Generator(),  # none of the training's random numbers
        )
        before = signal.getsignal(signal.SIGCHLD)
        with block_signals(signal.SIGINT):
            self._stream = iter(loader)
        if threading.current_thread() is threading.main_thread():
            # torch would raise wherever training is when a worker dies; `_next` finds out
            signal.signal(signal.SIGCHLD, before if before is not None else signal.SIG_DFL)

    def _draw(self) -> Iterator[Sample]:
        first, turns = self._source.first, self._turns
        owed = 0.0  # uses that the samples so far are good for
        while (news := self._next()) is not None:
            self.produced += len(news.number)
            self.following = max(self.following, int(news.number.max()) + 1)
            for number in news.number.tolist():
                self._source.starts[(number - first) % turns] = number + turns
            uses = self._reuse if self._buffer.full else max(1.0, self._reuse / 2)
            owed += len(news.number) * uses
            self._buffer.put(news)
            while owed >= self._batch_size and self._buffer.left >= self._batch_size:
                owed -= self._batch_size
                chosen = self._buffer.choose(self._batch_size, self._generator)
                self._used += self._batch_size
                yield self._imaged(Sample(*(column[chosen] for column in self._buffer.sample)))
                if self._source.worst is not None:
                    self._buffer.note(chosen, self._errors())
                    self._source.worst.put(self._buffer.worst())

    @property
    def _turns(self) -> int:
        """How many workers of all training processes take turns on the stream."""
        return max(1, self._workers) * self._source.lanes

    def _imaged(self, batch: Sample) -> Sample:
        if not self._group:
            return batch
        which = torch.randint(len(self._group), (len(batch.force),), generator=self._generator)
        force, displacement = (images(field, self._group, which) for field in batch[:2])
        return batch._replace(force=force, displacement=displacement)

    def _next(self) -> DrawnSample | None:
        """Return new samples; None at the end of a stream that has one."""
        start = time.monotonic()
        try:
            news = next(self._stream, None)
            self._restarts = 0
            return news
        except (RuntimeError, OSError, EOFError) as error:  # what a dead worker leaves behind
            self._restarts += 1
            died = "DataLoader worker" in str(error)
            died |= bool(self._workers) and not isinstance(error, RuntimeError)
            if not died or self._restarts > MAX_CONSECUTIVE_CRASHES:
                raise
            if self._restarts % MAX_RETRIES == 0:  # some load kills worker after worker
                lane, first = self._source.lane * self._workers, self._source.first
                for place in range(lane, lane + self._workers):
                    following = self._source.starts.get(place, first + place)
                    self._source.starts[place] = following + self._turns
            self._start()
            return self._next()
        finally:
            self._waited += time.monotonic() - start

    def close(self) -> None:
        """Stop the workers."""
        self._endless = self._stream = None


class _Buffer:
    """The last samples of a stream, with how often each may still be used, and its last error."""

    def __init__(self, capacity: int, reuse: int) -> None:
        self._capacity, self._reuse, self._count = capacity, reuse, 0
        self._left = torch.zeros(capacity, dtype=torch.int64)
        self._error = torch.zeros(capacity, dtype=torch.float64)
        self._point = torch.zeros(capacity, 0, dtype=torch.float64)
        self.sample = Sample(*(torch.zeros(0) for _ in Sample._fields))

    @property
    def full(self) -> bool:
        """Whether the oldest sample leaves for the next one."""
        return self._count >= self._capacity

    @property
    def size(self) -> int:
        """Samples kept."""
        return min(self._count, self._capacity)

    @property
    def left(self) -> int:
        """Uses that are left in all."""
        return int(self._left.sum())

    def put(self, news: DrawnSample) -> None:
        """Put samples in the place of the oldest ones."""
        if not self._count:  # memory is taken as it is written to
            self.sample = Sample(*(c.new_empty(self._capacity, *c.shape[1:]) for c in news.sample))
            self._point = news.point.new_zeros(self._capacity, news.point.shape[1])
        place = torch.arange(self._count, self._count + len(news.number)) % self._capacity
        for column, new in zip(self.sample, news.sample, strict=True):
            column[place] = new
        self._left[place], self._error[place] = self._reuse, 0.0
        self._point[place] = news.point
        self._count += len(news.number)

    def choose(self, count: int, generator: torch.Generator) -> Tensor:
        """Return the places of samples for a batch, none twice if there are enough, (B,)."""
        live = self._left.nonzero()[:, 0]
        if len(live) < count:
            live = torch.repeat_interleave(live, self._left[live])
        chosen = live[torch.randperm(len(live), generator=generator)[:count]]
        self._left -= torch.bincount(chosen, minlength=self._capacity)
        return chosen

    def note(self, chosen: Tensor, errors: Tensor | None) -> None:
        """Write down the surrogate's errors on a batch."""
        if errors is not None and len(errors) == len(chosen):
            self._error[chosen] = errors.double().cpu()

    def worst(self, part: float = 0.1) -> Tensor:
        """Return the points on which it was worst, a part of the buffer, worst first, (H, d)."""
        seen = int(self._error.count_nonzero())
        order = self._error.argsort(descending=True)[: int(np.ceil(part * seen))]
        return self._point[order]


def _begin(worker: int) -> None:
    """Make a worker process leave Ctrl-C to its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _batch(drawn: list[DrawnSample]) -> DrawnSample:
    return DrawnSample(
        stack([one.sample for one in drawn]),
        torch.stack([one.number for one in drawn]),
        torch.stack([one.point for one in drawn]),
    )

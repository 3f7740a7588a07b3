"""An endless stream of fresh samples, drawn and solved while the network trains."""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from dpl.data.generate import Job, outcome
from dpl.scene import Sample, Scene, stack


class Drawn(NamedTuple):
    """A sample (or a batch of them) and its place in the stream.

    Attributes:
        sample: The load with its answer.
        number: Which load of the stream, (B,).
    """

    sample: Sample
    number: Tensor


class OnlineSamples(IterableDataset):
    """The accepted loads of a stream, without end; every worker process solves its own.

    Attributes:
        scene: What is simulated.
        seed: Names the stream.
        first: Index of the first load.
    """

    def __init__(self, scene: Scene, seed: tuple[int, int], first: int = 0) -> None:
        """Keep the arguments, see the class."""
        self.scene, self.seed, self.first = scene, seed, first

    def __iter__(self) -> Iterator[Drawn]:
        """Yield samples (N, D), one at a time."""
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        for index in itertools.count(self.first + worker, workers):
            one = outcome(self.scene, Job(self.seed, index))
            if one.accepted:
                young = torch.tensor(one.young, dtype=torch.float64)
                fields = torch.from_numpy(one.force), torch.from_numpy(one.displacement)
                yield Drawn(Sample(*fields, young), torch.tensor(index))


class Replay:
    """Batches from a stream and from what it has given so far: a slow solver, a busy optimiser.

    Every `fresh` new samples enter a buffer (the oldest leave), and as many batches are drawn from
    it as make each sample count `reuse` times on average. One pass is an epoch of `batches`; the
    stream goes on from epoch to epoch.

    Attributes:
        produced: Samples taken from the stream so far.
        following: A number above all loads taken from the stream so far.
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
    ) -> None:
        """Keep the arguments, see the class; nothing starts before the first pass."""
        self.produced = self.following = 0
        self._batches, self._batch_size = batches, batch_size
        self._fresh, self._reuse, self._capacity = fresh, reuse, capacity
        self._loader = DataLoader(
            stream,
            batch_size=fresh,
            num_workers=workers,
            collate_fn=_batch,
            multiprocessing_context="spawn" if workers else None,
        )
        self._stream: Any = None
        self._endless: Iterator[Sample] | None = None
        self._generator = torch.Generator().manual_seed(0)

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return self._batches

    def __iter__(self) -> Iterator[Sample]:
        """Yield one epoch."""
        if self._endless is None:
            self._stream = iter(self._loader)
            self._endless = self._draw()
        return itertools.islice(self._endless, self._batches)

    def _draw(self) -> Iterator[Sample]:
        buffer: Sample | None = None
        owed = 0.0  # uses that the samples so far are still good for
        for news, numbers in self._stream:
            self.produced += len(numbers)
            self.following = max(self.following, int(numbers.max()) + 1)
            owed += len(numbers) * self._reuse
            parts = [news] if buffer is None else [buffer, news]
            buffer = Sample(
                *(torch.cat(column)[-self._capacity :] for column in zip(*parts, strict=True))
            )
            while owed >= self._batch_size:
                owed -= self._batch_size
                count = len(buffer.force)
                chosen = torch.randint(count, (self._batch_size,), generator=self._generator)
                yield Sample(*(column[chosen] for column in buffer))

    def close(self) -> None:
        """Stop the workers."""
        self._endless = self._stream = None


def _batch(drawn: list[Drawn]) -> Drawn:
    return Drawn(stack([one.sample for one in drawn]), torch.stack([one.number for one in drawn]))

"""Endless stream of samples that are drawn and solved while a network trains."""

import itertools
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from dpl.data.solving.solve import LoadKey, SolvedLoad, failed_load, solve_load
from dpl.data.solving.worker_pool import STARTUP_GRACE
from dpl.scene import Sample, Scene


class DrawnSample(NamedTuple):
    """A sample, or a batch of samples, with its position in the stream.

    Attributes:
        sample: Load and solution.
        number: Number of the load in the stream, (B,).
    """

    sample: Sample
    number: Tensor


@dataclass(eq=False)
class OnlineSamples(IterableDataset):
    """The accepted loads of an endless stream; each worker process solves its own.

    Attributes:
        scene: Scene whose loads are solved.
        seed: Seed of the stream.
        first: Number of the first load.
        rank: Index of this training process.
        world_size: Number of training processes, which share the stream.
        offsets: Number of the next load of a worker, by its index among the workers of all
            training processes; worker k starts at `first + k` by default.
        timeout: Time limit for a load in a worker [s]; None: no limit.
    """

    scene: Scene
    seed: tuple[int, int]
    first: int = 0
    _: KW_ONLY
    rank: int = 0
    world_size: int = 1
    timeout: float | None = None
    offsets: dict[int, int] = field(default_factory=dict)

    def __iter__(self) -> Iterator[DrawnSample]:
        """Yield single samples, fields of shape (N, D)."""
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        index = self.rank * workers + worker
        first = self.offsets.get(index, self.first + index)
        grace = STARTUP_GRACE
        for number in itertools.count(first, workers * self.world_size):
            limit = self.timeout + grace if self.timeout and info is not None else None
            solved, grace = self._solve(number, limit), 0.0
            if solved.accepted:
                yield self._drawn_sample(solved)

    def _solve(self, number: int, limit: float | None) -> SolvedLoad:
        """Solve a load within a time limit [s]; return it as failed beyond the limit."""
        job = LoadKey(self.seed, number)
        try:
            with _time_limit(limit):
                return solve_load(self.scene, job)
        except TimeoutError as error:
            return failed_load(self.scene, job, str(error))

    def _drawn_sample(self, solved: SolvedLoad) -> DrawnSample:
        loads, point = self.scene.loads, torch.from_numpy(solved.point)[None]
        fields = map(torch.from_numpy, (solved.force, solved.displacement))
        sample = Sample(*fields, loads.young_at(point)[0], loads.parameters_at(point)[0])
        return DrawnSample(sample, torch.tensor(solved.job.number))


@contextmanager
def _time_limit(seconds: float | None) -> Iterator[None]:
    """Raise TimeoutError if the body takes longer; works in the main thread of a process only."""
    if seconds is None:
        yield
        return

    def stop(*_: object) -> None:
        raise TimeoutError(f"timed out after {seconds:g} s")

    previous = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)

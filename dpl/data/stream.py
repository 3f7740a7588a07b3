"""Endless stream of samples that are drawn and solved while a network trains."""

import itertools
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from dpl.data.solving.solve import LoadKey, SolvedLoad, failed_load, solve_load
from dpl.data.solving.worker_pool import STARTUP_GRACE
from dpl.data.storage.shard import to_dense
from dpl.data.storage.store import Store
from dpl.scene import Sample, Scene

PERTURBATION = 0.05  # standard deviation of a load from a hard example, in the unit cube


class DrawnSample(NamedTuple):
    """A sample, or a batch of samples, with its position in the stream.

    Attributes:
        sample: Load and solution.
        number: Number of the load in the stream, (B,).
        point: Point of the unit cube that the load is drawn from, (B, d).
    """

    sample: Sample
    number: Tensor
    point: Tensor


class HardExamples:
    """Points with the largest errors of the surrogate; workers read what the training writes.

    Attributes:
        points: Points of the unit cube, of which the first `count` are valid, (H, d), shared.
        count: Number of valid points, (1,), shared.
    """

    def __init__(self, dimension: int, size: int = 64) -> None:
        """Allocate memory for `size` points of this dimension; none is valid yet."""
        self.points = torch.zeros(size, dimension, dtype=torch.float64).share_memory_()
        self.count = torch.zeros(1, dtype=torch.int64).share_memory_()

    def update(self, points: Tensor) -> None:
        """Replace the points by new ones, sorted by descending error."""
        count = min(len(points), len(self.points))
        self.points[:count] = points[:count]
        self.count.fill_(count)

    def sample(self, rng: np.random.Generator) -> Tensor | None:
        """Return a random point near one of them, (d,); None while there are none."""
        if not (count := int(self.count)):
            return None
        centre = self.points[int(rng.integers(count))].numpy()
        # reflected at 0 and at 1, so that no probability accumulates on the faces of the cube
        reflected = np.abs(centre + PERTURBATION * rng.standard_normal(len(centre))) % 2
        return torch.from_numpy(np.minimum(reflected, 2 - reflected).clip(0, 1 - 2.0**-53))


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
        store: Data set that keeps solved loads and provides those that it has; None: not used.
        hard_examples: Points with the largest errors; None: loads are drawn from the stream only.
        hard_example_fraction: Fraction of the loads that are drawn near hard examples.
        timeout: Time limit for a load in a worker [s]; None: no limit.
    """

    scene: Scene
    seed: tuple[int, int]
    first: int = 0
    _: KW_ONLY
    rank: int = 0
    world_size: int = 1
    store: Store | None = None
    hard_examples: HardExamples | None = None
    hard_example_fraction: float = 0.0
    timeout: float | None = None
    offsets: dict[int, int] = field(default_factory=dict)

    def __iter__(self) -> Iterator[DrawnSample]:
        """Yield single samples, fields of shape (N, D)."""
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        index = self.rank * workers + worker
        first = self.offsets.get(index, self.first + index)
        read = self.store.reader("train") if self.store else None
        grace = STARTUP_GRACE
        for number in itertools.count(first, workers * self.world_size):
            stored = read(number) if read else None
            if stored is None:
                limit = self.timeout + grace if self.timeout and info is not None else None
                solved, grace = self._solve(number, limit), 0.0
                if self.store:
                    self.store.pending.write(solved)
                if solved.accepted:
                    fields = (solved.point, solved.force, solved.displacement)
                    yield self._drawn_sample(number, *map(torch.from_numpy, fields))
            elif len(stored["index"]):
                force = to_dense(stored, self.scene.problem.shape)[0]
                yield self._drawn_sample(
                    number, stored["point"][0], force, stored["displacement"][0]
                )

    def _drawn_sample(
        self, number: int, point: Tensor, force: Tensor, displacement: Tensor
    ) -> DrawnSample:
        loads = self.scene.loads
        young, parameters = (at(point[None])[0] for at in (loads.young_at, loads.parameters_at))
        sample = Sample(force, displacement, young, parameters)
        return DrawnSample(sample, torch.tensor(number), point)

    def _solve(self, number: int, limit: float | None) -> SolvedLoad:
        """Solve a load within a time limit [s]; return it as failed beyond the limit."""
        job, point = LoadKey(self.seed, number), None
        if self.hard_examples is not None:
            seeds = np.random.SeedSequence((*self.seed, 1), spawn_key=(number,))
            rng = np.random.default_rng(seeds)
            if rng.random() < self.hard_example_fraction:
                point = self.hard_examples.sample(rng)
        try:
            with _time_limit(limit):
                return solve_load(self.scene, job, point=point)
        except TimeoutError as error:
            return failed_load(self.scene, job, str(error))


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

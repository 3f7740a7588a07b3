"""An endless stream of fresh samples, drawn and solved while the network trains."""

import itertools
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from dpl.data.solving.solve import LoadKey, SolvedLoad, failed_load, solve_load
from dpl.data.solving.worker_pool import STARTUP_GRACE
from dpl.data.storage.store import Store
from dpl.scene import Sample, Scene

NEIGHBOURHOOD = (
    0.05  # deviation from a bad load, in the unit cube, of the loads that are drawn near it
)


class DrawnSample(NamedTuple):
    """A sample (or a batch of them) and its place in the stream.

    Attributes:
        sample: The load with its answer.
        number: Which load of the stream, (B,).
        point: Point of the unit cube that the load stands for, (B, d).
    """

    sample: Sample
    number: Tensor
    point: Tensor


class HardExamples:
    """Where the surrogate is worst at present: written by the trainer, read by all workers.

    Attributes:
        points: Points of the unit cube, of which the first `count` count, (H, d), shared.
        count: How many there are, (1,), shared.
    """

    def __init__(self, dimension: int, size: int = 64) -> None:
        """Begin with none."""
        self.points = torch.zeros(size, dimension, dtype=torch.float64).share_memory_()
        self.count = torch.zeros(1, dtype=torch.int64).share_memory_()

    def put(self, points: Tensor) -> None:
        """Put new points, the worst first, in the place of the old ones."""
        count = min(len(points), len(self.points))
        self.points[:count] = points[:count]
        self.count.fill_(count)

    def near(self, rng: np.random.Generator) -> Tensor | None:
        """Return a point near one of them, (d,); None while there are none."""
        if not (count := int(self.count)):
            return None
        centre = self.points[int(rng.integers(count))].numpy()
        moved = (
            np.abs(centre + NEIGHBOURHOOD * rng.standard_normal(len(centre))) % 2
        )  # folded back at 0
        return torch.from_numpy(np.minimum(moved, 2 - moved).clip(0, 1 - 2.0**-53))  # and at 1


class OnlineSamples(IterableDataset):
    """The accepted loads of a stream, without end; every worker process solves its own.

    Attributes:
        scene: What is simulated.
        seed: Names the stream.
        first: Index of the first load.
        starts: Index of the first load of some places, each the turn of one worker of one lane;
            the others begin at `first`.
        lane, lanes: Which training process this is, of how many; they share the stream.
        store: Keeps what is solved and gives what it has; none if left out.
        worst: Where the surrogate is worst; none if left out.
        near: Part of the loads that are drawn near those.
        timeout: Longest time for a load in a worker [s]; None: no limit.
    """

    def __init__(
        self,
        scene: Scene,
        seed: tuple[int, int],
        first: int = 0,
        *,
        lane: int = 0,
        lanes: int = 1,
        store: Store | None = None,
        worst: HardExamples | None = None,
        near: float = 0.0,
        timeout: float | None = None,
    ) -> None:
        """Keep the arguments, see the class."""
        self.scene, self.seed, self.first = scene, seed, first
        self.starts: dict[int, int] = {}
        self.lane, self.lanes = lane, lanes
        self.store, self.worst, self.near, self.timeout = store, worst, near, timeout

    def __iter__(self) -> Iterator[DrawnSample]:
        """Yield samples (N, D), one at a time."""
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        place = self.lane * workers + worker
        first = self.starts.get(place, self.first + place)
        known = self.store.reader("train") if self.store else None
        grace = STARTUP_GRACE
        for index in itertools.count(first, workers * self.lanes):
            one = known(index) if known else None
            if one is None:
                limit = self.timeout + grace if self.timeout and info is not None else None
                one, grace = self._solved(index, limit), 0.0
                if self.store:
                    self.store.pending.put(one)
            if one.accepted:
                point = torch.from_numpy(one.point)
                loads, where = self.scene.loads, point[None]
                moduli = loads.young_at(where)[0], loads.poisson_at(where)[0]
                fields = torch.from_numpy(one.force), torch.from_numpy(one.displacement)
                yield DrawnSample(Sample(*fields, *moduli), torch.tensor(index), point)

    def _solved(self, index: int, limit: float | None) -> SolvedLoad:
        """Return a load, solved within so many seconds, or recorded as lost."""
        job, point = LoadKey(self.seed, index), None
        if self.worst is not None:
            rng = np.random.default_rng(np.random.SeedSequence((*self.seed, 1), spawn_key=(index,)))
            point = self.worst.near(rng) if rng.random() < self.near else None
        try:
            with _within(limit):
                return solve_load(self.scene, job, point=point)
        except TimeoutError as error:
            return failed_load(self.scene, job, str(error))


@contextmanager
def _within(seconds: float | None) -> Iterator[None]:
    """Raise TimeoutError if the body takes longer; in the main thread of a process only."""
    if seconds is None:
        yield
        return

    def end(*_: object) -> None:
        raise TimeoutError(f"timed out after {seconds:g} s")

    before = signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)

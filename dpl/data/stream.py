"""Endless stream of samples that worker processes solve while a network trains."""

import itertools
from collections.abc import Generator, Iterator
from dataclasses import KW_ONLY, dataclass, field

import torch

from dpl.data.solving.background import Background, StopFlag
from dpl.data.solving.solve import LoadKey, SolvedLoad
from dpl.data.solving.worker_pool import solve_loads
from dpl.scene import Sample, Scene

AHEAD = 8  # solved loads, for each worker, that wait to be used
MAX_EARLY = 256  # loads solved before a load of a smaller number, after which that one is left out


@dataclass(eq=False)
class SampleStream:
    """The accepted loads of an endless stream, in the order of their numbers.

    Worker processes solve loads ahead of their use. Without workers a load is solved when it is
    needed. Nothing is solved before the first sample is needed.

    Attributes:
        scene: Scene whose loads are solved.
        seed: Seed of the stream.
        first: Number of the first load.
        rank: Index of this training process.
        world_size: Number of training processes, which share the stream.
        workers: Number of worker processes, one core each; 0: solve in this process.
        timeout: Time limit for a load in a worker [s]; None: no limit.
    """

    scene: Scene
    seed: tuple[int, int]
    _: KW_ONLY
    first: int = 0
    rank: int = 0
    world_size: int = 1
    workers: int = 0
    timeout: float | None = None
    _solved: Background[SolvedLoad] | None = field(default=None, init=False)

    def __iter__(self) -> Iterator[tuple[int, Sample]]:
        """Yield numbers and samples, fields of shape (N, D)."""
        ahead = AHEAD * self.workers
        self._solved = Background(self._solve, thread=self.workers > 0, ahead=ahead)
        early: dict[int, SolvedLoad] = {}
        for number in self._numbers():
            while number not in early and len(early) < MAX_EARLY:
                if (solved := self._solved.get()) is None:  # the stream has been closed
                    return
                if solved.job.number >= number:
                    early[solved.job.number] = solved
            found = early.pop(number, None)
            if found is not None and found.accepted:
                yield number, self._sample(found)

    def _numbers(self) -> Iterator[int]:
        return itertools.count(self.first + self.rank, self.world_size)

    def _solve(self, stop: StopFlag) -> Generator[SolvedLoad, None, None]:
        jobs = (LoadKey(self.seed, number) for number in self._numbers())
        return solve_loads(self.scene, jobs, workers=self.workers, timeout=self.timeout, stop=stop)

    def _sample(self, solved: SolvedLoad) -> Sample:
        loads, point = self.scene.loads, torch.from_numpy(solved.point)[None]
        force, displacement = map(torch.from_numpy, (solved.force, solved.displacement))
        return Sample(force, displacement, loads.young_at(point)[0], loads.parameters_at(point)[0])

    def close(self) -> None:
        """Finish the solves in progress and end the workers."""
        if self._solved is not None:
            self._solved.close()

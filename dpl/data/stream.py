"""Endless stream of samples that worker processes solve while a network trains."""

import itertools
import queue
import threading
from collections.abc import Generator, Iterator
from contextlib import closing, suppress

import torch

from dpl.data.background import StopFlag, join
from dpl.data.solving.solve import LoadKey, SolvedLoad
from dpl.data.solving.worker_pool import solve_loads
from dpl.scene import Sample, Scene

AHEAD = 8  # solved loads, for each worker, that wait to be used
MAX_EARLY = 256  # loads solved before a load of a smaller number, after which that one is left out


class SampleStream:
    """The accepted loads of an endless stream, in the order of their numbers.

    A thread supervises the worker processes, which solve loads ahead of their use. Without workers
    there is no thread, and a load is solved when it is needed.

    Attributes:
        first: Number of the first load.
        world_size: Number of training processes, which share the stream.
        workers: Number of worker processes of each training process.
    """

    def __init__(
        self,
        scene: Scene,
        seed: tuple[int, int],
        *,
        first: int = 0,
        rank: int = 0,
        world_size: int = 1,
        workers: int = 0,
        timeout: float | None = None,
    ) -> None:
        """Describe the stream; nothing is solved before the first sample is needed.

        Args:
            scene: Scene whose loads are solved.
            seed: Seed of the stream.
            first: Number of the first load.
            rank: Index of this training process.
            world_size: Number of training processes.
            workers: Number of worker processes, one core each; 0: solve in this process.
            timeout: Time limit for a load in a worker [s]; None: no limit.
        """
        self.first, self.world_size, self.workers = first, world_size, workers
        self._scene, self._seed, self._rank, self._timeout = scene, seed, rank, timeout
        self._solved: queue.Queue[SolvedLoad | BaseException] = queue.Queue(AHEAD * workers)
        self._stop = StopFlag()
        self._thread = threading.Thread(target=self._run, name="stream", daemon=True)

    def __iter__(self) -> Iterator[tuple[int, Sample]]:
        """Yield numbers and samples, fields of shape (N, D)."""
        solving = self._solve_in_background() if self.workers else self._solve()
        early: dict[int, SolvedLoad] = {}
        for number in self._numbers():
            while number not in early and len(early) < MAX_EARLY:
                if (solved := next(solving, None)) is None:  # the stream has been closed
                    return
                if solved.job.number >= number:
                    early[solved.job.number] = solved
            found = early.pop(number, None)
            if found is not None and found.accepted:
                yield number, self._sample(found)

    def _numbers(self) -> Iterator[int]:
        return itertools.count(self.first + self._rank, self.world_size)

    def _solve(self) -> Generator[SolvedLoad, None, None]:
        jobs = (LoadKey(self._seed, number) for number in self._numbers())
        return solve_loads(
            self._scene, jobs, workers=self.workers, timeout=self._timeout, stop=self._stop
        )

    def _solve_in_background(self) -> Iterator[SolvedLoad]:
        self._thread.start()
        while not isinstance(solved := self._solved.get(), BaseException):
            yield solved
        raise solved

    def _run(self) -> None:
        """Solve all loads."""
        try:
            with closing(self._solve()) as solving:
                for solved in solving:
                    self._put(solved)
                    if self._stop:
                        break
        except BaseException as error:  # raised again in the thread that waits
            self._put(error)

    def _put(self, solved: SolvedLoad | BaseException) -> None:
        """Wait for a place in the queue until the stream is closed."""
        while not self._stop:
            with suppress(queue.Full):
                self._solved.put(solved, timeout=0.1)
                return

    def _sample(self, solved: SolvedLoad) -> Sample:
        loads, point = self._scene.loads, torch.from_numpy(solved.point)[None]
        force, displacement = map(torch.from_numpy, (solved.force, solved.displacement))
        return Sample(force, displacement, loads.young_at(point)[0], loads.parameters_at(point)[0])

    def close(self) -> None:
        """End the workers as soon as one of them has solved its load."""
        self._stop.set()
        if self._thread.is_alive():
            join(self._thread)

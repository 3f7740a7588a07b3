"""A data set with the sizes that are wanted, and its generation with progress and interruption."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    track,
)

from dpl.data.solving.solve import LoadKey
from dpl.data.solving.worker_pool import GracefulShutdown
from dpl.data.storage.acceptance import bias_warning
from dpl.data.storage.integrity import repair, verify
from dpl.data.storage.journal import Session
from dpl.data.storage.store import Store
from dpl.data.storage.writer import Writer
from dpl.scene import Scene

MAX_LOADS = 10**7  # in a split
MAX_WORKERS = 1024


def check_range(low: float, high: float, **values: float) -> None:
    """Raise ValueError if a value, named by its keyword, is not in [low, high]."""
    for name, value in values.items():
        if not low <= value <= high:
            raise ValueError(f"{name} = {value} must lie between {low:,} and {high:,}")


@dataclass(frozen=True)
class DataSet:
    """A data set with the sizes that are wanted; it may exist in part or not at all.

    Attributes:
        scene: Scene of the loads.
        folder: Folder of the data set; None: named after the scene's fingerprint and the seed.
        seed: Seed of the loads.
        train: Number of loads to train on.
        val: Number of loads to validate on.
        test: Number of loads to test on.
        workers: Number of processes that solve, one core each; 0: solve in this process.
        timeout: Time limit for a load [s]; None: no limit.
        shard: Index of this process among `shards` processes that share the work.
        shards: Number of these processes; each makes its part of the files.
    """

    scene: Scene
    folder: str | None = None
    seed: int = 0
    train: int = 1000
    val: int = 100
    test: int = 100
    workers: int = 2
    timeout: float | None = 600.0
    shard: int = 0
    shards: int = 1

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: A number is out of range.
        """
        check_range(0, 2**32 - 1, seed=self.seed)
        check_range(0, MAX_LOADS, **self.sizes)
        check_range(0, MAX_WORKERS, workers=self.workers)
        if self.timeout is not None and not self.timeout > 0:
            raise ValueError(f"timeout = {self.timeout} must be above 0 [s], or null")
        if self.shards < 1:
            raise ValueError(f"shards = {self.shards} must be 1 or more")
        check_range(0, self.shards - 1, shard=self.shard)

    @cached_property
    def store(self) -> Store:
        """Files of the data set."""
        name = f"datasets/{self.scene.fingerprint[:12]}-seed{self.seed}"
        return Store(Path(self.folder or name), self.scene, self.seed)

    @property
    def sizes(self) -> dict[str, int]:
        """Number of loads wanted in each split."""
        return {"train": self.train, "val": self.val, "test": self.test}

    def missing(self) -> dict[str, list[int]]:
        """Return the loads of this process that have not been tried, by split."""
        return {
            split: self.store.missing(split, size, self.shard, self.shards)
            for split, size in self.sizes.items()
        }

    def skipped_work(self) -> list[str]:
        """Return one line for each kind of work that is not needed."""
        wanted = sum(self.sizes.values())
        there = wanted - sum(len(self.store.missing(*split)) for split in self.sizes.items())
        lines = [
            "one data set for every size and Young's modulus of this body: "
            f"{self.store.folder}, of scene {self.scene.fingerprint[:12]}"
        ]
        if there:
            lines.append(f"{there} of {wanted} loads not solved again: they are there")
        return lines

    def fill(self) -> Store:
        """Solve the missing loads under a progress bar; return the data set.

        After the first SIGINT or SIGTERM, the solves in progress are finished. Solved loads are
        kept in any case.

        Raises:
            DataSetError: The folder holds something else, or another process writes there.
            KeyboardInterrupt: The run was interrupted.
        """
        missing = self.missing()
        if any(missing.values()):
            self._solve(missing)
        if warning := bias_warning(self.store.acceptance()):
            print(f"warning: {warning}", file=sys.stderr)
        return self.store

    def _solve(self, missing: Mapping[str, Sequence[int]]) -> None:
        """Solve these loads, by split, under a progress bar."""
        columns = (
            TextColumn("solving {task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[news]}"),
            TimeRemainingColumn(),
        )
        jobs = {
            LoadKey(self.store.stream(split), number)
            for split, numbers in missing.items()
            for number in numbers
        }
        completed = len(jobs & self.store.pending.files().keys())
        session = Session(workers=self.workers)
        with GracefulShutdown() as stop, Progress(*columns, refresh_per_second=2) as progress:
            bar = progress.add_task("loads", total=len(jobs), completed=completed, news="")
            writer = Writer(self.store, self.shard, self.shards)
            solving = writer.fill(missing, workers=self.workers, timeout=self.timeout, stop=stop)
            try:
                with closing(solving):  # ends the workers first
                    for solved in solving:
                        news = session.count(solved.accepted, solved.seconds)
                        progress.update(bar, advance=1, news=news)
            finally:
                session.append_to_journal(self.store.folder)
            stop.exit()

    def verify(self) -> Iterator[str]:
        """Yield one line for each flaw of the data set.

        Flaws are those of `dpl.data.storage.integrity.verify`, and missing loads.

        Raises:
            DataSetError: There is no data set.
        """
        files = len(self.store.shards()) + 1
        for part, flaw in track(verify(self.store), "verifying files", total=files):
            if flaw:
                yield f"{self.store.folder / part.file} {flaw}"
        for split, numbers in self.missing().items():
            if numbers:
                yield (
                    f"{self.store.folder} lacks {len(numbers)} of the loads that data.{split} = "
                    f"{self.sizes[split]} requires; the first is load {numbers[0]}"
                )

    def repair(self) -> Store:
        """Make damaged files again, also beyond the sizes wanted; return the data set.

        One line is printed for each flaw.
        """
        flaws = repair(self.store)
        missing = self.missing()
        for part, action in flaws:
            print(f"{self.store.folder / part.file} {action}")
            if part.split:
                missing[part.split] = sorted({*missing[part.split], *part.loads})
        for split, numbers in missing.items():
            if numbers:
                print(f"{len(numbers)} loads of {split} are missing and are solved")
        if any(missing.values()):
            self._solve(missing)
        return self.fill()

"""What is wanted of a data set, and the long work of filling it: progress, interruption, report."""

import os
import platform
import socket
import sys
import time
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
from dpl.data.storage import acceptance
from dpl.data.storage.integrity import repair, verify
from dpl.data.storage.store import Store
from dpl.data.storage.writer import Writer
from dpl.scene import Scene
from dpl.system.files import append_jsonl
from dpl.version import __version__

MOST = 10**7  # loads in a split
WORKERS = 1024  # processes on a machine


@dataclass(frozen=True)
class DataSet:
    """A data set as it is wanted, there or not.

    Attributes:
        scene: What is simulated.
        folder: Where it is; named after the scene's fingerprint and the seed if left out.
        seed: Names the loads.
        train: Loads to train on.
        val: Loads to validate on.
        test: Loads to test on.
        workers: Processes that solve, one core each; 0: this one.
        timeout: Longest time for one load [s]; null: no limit.
        shard: Which part of the files to make, from 0, of
        shards: so many parts, each made by a process of its own.
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
        spans = {"seed": 2**32 - 1, "train": MOST, "val": MOST, "test": MOST, "workers": WORKERS}
        for name, most in spans.items():
            if not 0 <= getattr(self, name) <= most:
                told = f"{name} = {getattr(self, name)} must be 0 or more and at most {most:,}"
                raise ValueError(told)
        if self.shards < 1:
            raise ValueError(f"shards = {self.shards} must be 1 or more")
        if self.timeout is not None and not self.timeout > 0:
            raise ValueError(f"timeout = {self.timeout} must be above 0 [s], or null")
        if not 0 <= self.shard < self.shards:
            raise ValueError(
                f"shard = {self.shard} must be one of 0 to shards - 1 = {self.shards - 1}"
            )

    @cached_property
    def store(self) -> Store:
        """Where it is kept."""
        name = f"datasets/{self.scene.fingerprint[:12]}-seed{self.seed}"
        return Store(Path(self.folder or name), self.scene, self.seed)

    @property
    def sizes(self) -> dict[str, int]:
        """Loads wanted in each split."""
        return {"train": self.train, "val": self.val, "test": self.test}

    def missing(self) -> dict[str, list[int]]:
        """Return the loads of this part that have not been tried, by split."""
        return {
            split: self.store.missing(split, size, self.shard, self.shards)
            for split, size in self.sizes.items()
        }

    def skipped_work(self) -> list[str]:
        """Return what need not be solved, a line each."""
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
        """Return the data set; what is missing is solved under a progress bar.

        Ctrl-C and SIGTERM once finish the loads at work. What is solved is kept in any case.

        Raises:
            DataSetError: The folder holds something else, or another process writes there.
            KeyboardInterrupt: Stopped.
        """
        missing = self.missing()
        if any(missing.values()):
            self._solve(missing)
        if told := acceptance.bias_warning(self.store.acceptance()):
            print(f"warning: {told}", file=sys.stderr)
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
        found = len(jobs & self.store.pending.files().keys())
        done = _Session(workers=self.workers)
        with GracefulShutdown() as stop, Progress(*columns, refresh_per_second=2) as progress:
            bar = progress.add_task("loads", total=len(jobs), completed=found, news="")
            writer = Writer(self.store, self.shard, self.shards)
            solving = writer.fill(missing, workers=self.workers, timeout=self.timeout, stop=stop)
            try:
                with closing(solving):  # which ends the workers before anything else
                    for one in solving:
                        news = done.count(one.accepted, one.seconds)
                        progress.update(bar, advance=1, news=news)
            finally:
                done.write(self.store.folder)
            stop.exit()

    def verify(self) -> Iterator[str]:
        """Yield what is wrong with the data set, a line for each flaw.

        Flaws are those of `dpl.data.storage.integrity.verify`, and loads that are
        wanted and are not there.

        Raises:
            DataSetError: There is no data set.
        """
        files = len(self.store.shards()) + 1
        for part, flaw in track(verify(self.store), "looking at files", total=files):
            if flaw:
                yield f"{self.store.folder / part.file} {flaw}"
        for split, numbers in self.missing().items():
            if numbers:
                yield (
                    f"{self.store.folder} lacks {len(numbers)} of the loads that data.{split} = "
                    f"{self.sizes[split]} asks for; the first is load {numbers[0]}"
                )

    def repair(self) -> Store:
        """Return the data set, its damaged files made again, also those beyond the sizes wanted.

        What is done is printed, a line for each flaw.
        """
        mended = repair(self.store)
        missing = self.missing()
        for part, told in mended:
            print(f"{self.store.folder / part.file} {told}")
            if part.split:
                missing[part.split] = sorted({*missing[part.split], *part.loads})
        for split, numbers in missing.items():
            if numbers:
                print(f"{len(numbers)} loads of {split} are not there; they are solved")
        if any(missing.values()):
            self._solve(missing)
        return self.fill()


class _Session:
    """What one run of the generator has done, for the progress bar and the journal."""

    def __init__(self, workers: int) -> None:
        self.workers, self.loads, self.accepted, self.core_seconds = workers, 0, 0, 0.0
        self.started, self.begin = time.strftime("%Y-%m-%d %H:%M:%S"), time.perf_counter()

    def count(self, accepted: bool, seconds: float) -> str:
        """Count a load; return the news."""
        self.loads += 1
        self.accepted += accepted
        self.core_seconds += seconds
        rate = self.loads / (time.perf_counter() - self.begin)
        return f"{self.accepted} accepted, {self.loads - self.accepted} rejected, {rate:.1f}/s"

    def write(self, folder: Path) -> None:
        """Add a line to the journal."""
        if self.loads and folder.is_dir():
            line = {
                "started": self.started,
                "machine": socket.gethostname(),
                "process": os.getpid(),
                "python": platform.python_version(),
                "dpl": __version__,
                "workers": self.workers,
                "loads": self.loads,
                "seconds": round(time.perf_counter() - self.begin, 3),
                "core_seconds": round(self.core_seconds, 3),
            }
            append_jsonl(folder / "journal.jsonl", line)

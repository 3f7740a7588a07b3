"""A data set with the sizes that are wanted, and its generation with progress and interruption."""

import json
import math
import os
import platform
import socket
import sys
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from rich import progress

from dpl.data.solving.background import Background
from dpl.data.solving.solve import LoadKey, SolvedLoad
from dpl.data.solving.worker_pool import graceful_shutdown, solve_loads
from dpl.data.storage.integrity import repair, verify
from dpl.data.storage.store import FORMAT, JOURNAL, STREAMS, Store, bias_warning, blocks
from dpl.scene import Scene
from dpl.system.checks import check_range
from dpl.system.files import append_jsonl, exclusive_lock, write_file
from dpl.version import __version__

MAX_LOADS = 10**7  # in a split
MAX_WORKERS = 1024
REFRESH = 0.5  # time between two updates of the progress bar [s]
PARTIAL_FILE_AGE = 10.0  # age above which the writer of an unfinished file is taken for dead [s]


@dataclass(frozen=True)
class DataSet:
    """A data set with the sizes that are wanted; it may exist in part or not at all.

    Attributes:
        scene: Scene of the loads.
        folder: Folder of the data set; None: named after the scene's fingerprint and the seed.
        seed: Seed of the loads.
        train, val, test: Numbers of loads of the splits.
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
        check_range(0, 2**32 - 1, seed=self.seed)
        check_range(0, MAX_LOADS, **self.sizes)
        check_range(0, MAX_WORKERS, workers=self.workers)
        if self.timeout is not None and not self.timeout > 0:
            raise ValueError(f"timeout = {self.timeout} must be above 0 [s], or null")
        check_range(1, shards=self.shards)
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

    def describe(self) -> list[tuple[str, str]]:
        """Return the numbers of loads, and how many of them have to be solved."""
        sizes = ", ".join(f"{size:,} {split}" for split, size in self.sizes.items() if size)
        missing = sum(self.sizes.values()) - self._tried
        return [("data", f"loads: {sizes}; {missing:,} of them to be solved")]

    @property
    def _tried(self) -> int:
        """Number of the loads wanted that have been tried, those of other parts included."""
        return sum(k < size for split, size in self.sizes.items() for k in self.store.tried(split))

    def skipped_work(self) -> list[str]:
        """Return one line for each kind of work that is not needed."""
        wanted, there = sum(self.sizes.values()), self._tried
        problem, constant = self.scene.problem, self.scene.loads.constant_force
        fixed = constant is not None or problem.has_one_modulus or problem.moved_supports
        same = " with these boundary values over E and L" if fixed else ""
        units = {*problem.follower_loads.units.values()}  # of parameters
        sizes = "" if units - {"Pa"} else " for every size" + " and Young's modulus" * (not units)
        lines = [
            f"one data set{sizes} of this body{same}: "
            f"{self.store.folder}, of scene {self.scene.fingerprint[:12]}"
        ]
        if there:
            lines.append(f"{there} of {wanted} loads not solved again: they are there")
        return lines

    def fill(self) -> Store:
        """Solve the missing loads under a progress bar; return the data set.

        After the first SIGINT or SIGTERM, the solves in progress are finished; then
        KeyboardInterrupt or SystemExit is raised. Solved loads are kept in any case.
        """
        self._solve_with_progress(self.missing())
        if warning := bias_warning(self.store.acceptance()):
            print(f"warning: {warning}", file=sys.stderr)
        return self.store

    def _solve_with_progress(self, missing: Mapping[str, Sequence[int]]) -> None:
        """Solve these loads, by split, under a progress bar."""
        total = sum(map(len, missing.values()))
        if total or self.store.scattered(self.shard, self.shards):
            with (
                graceful_shutdown() as stop,
                closing(LoadSolver(self, missing.items(), stop=stop)) as solver,
            ):
                solver.finish(total)

    def create(self) -> None:
        """Write `scene.json` if it is missing; raise DataSetError if the folder is no data set."""
        folder, scene = self.store.folder, self.scene
        if self.store.exists():
            return
        folder.mkdir(parents=True, exist_ok=True)
        card = {
            "format": FORMAT,
            "fingerprint": scene.fingerprint,
            "scene": scene.identity(),
            "seed": self.seed,
            "versions": {"dpl": __version__, "torch": torch.__version__, "numpy": np.__version__},
        }
        write_file(folder / "scene.json", json.dumps(card, indent=1).encode())

    def solve(
        self, loads: Iterable[tuple[str, Sequence[int]]], stop: object = None
    ) -> Generator[SolvedLoad, None, None]:
        """Solve loads that have not been tried; yield each as soon as it is solved.

        Each solved load is written to a file at once. The files of a block are merged as soon as
        all its loads that are wanted have been tried.

        Args:
            loads: Splits with numbers of loads, in the order of the solves; read when they are due.
            stop: See `solve_loads`.

        Raises:
            DataSetError: The folder holds something else, or another process writes there.
            RuntimeError: Workers die repeatedly.
        """
        self.create()
        store = self.store
        with exclusive_lock(store.folder, self.shard, self.shards):
            for path in store.folder.rglob(".*.part"):  # of killed processes
                with suppress(FileNotFoundError):
                    if time.time() - path.stat().st_mtime > PARTIAL_FILE_AGE:
                        path.unlink()
            for block in store.scattered(self.shard, self.shards):  # of an interrupted session
                store.merge(*block)
            tried = {
                LoadKey(store.stream(shard.split), number)
                for shard in store.shards()
                for number in shard.tried
            }
            unmerged: list[tuple[str, int, set[LoadKey]]] = []  # blocks with their loads wanted

            def jobs() -> Iterator[LoadKey]:
                for split, numbers in loads:
                    for block, members in blocks(numbers):
                        keys = [LoadKey(store.stream(split), number) for number in members]
                        new = [key for key in keys if key not in tried]
                        unmerged.append((split, block, set(new)))
                        yield from new

            def merge_complete_blocks() -> None:
                while unmerged and unmerged[0][2] <= tried:
                    store.merge(*unmerged.pop(0)[:2])

            workers, timeout = self.workers, self.timeout
            for solved in solve_loads(
                self.scene, jobs(), workers=workers, timeout=timeout, stop=stop
            ):
                store.write(solved)
                tried.add(solved.job)
                merge_complete_blocks()
                yield solved
            merge_complete_blocks()  # of loads that another session had tried

    def verify(self) -> Iterator[str]:
        """Yield one line for each flaw of the data set, and for missing loads."""
        total = len(self.store.files())
        for path, flaw in progress.track(verify(self.store), "verifying files", total=total):
            if flaw:
                yield f"{path} {flaw}"
        for split, numbers in self.missing().items():
            if numbers:
                yield (
                    f"{self.store.folder} lacks {len(numbers)} of the loads that data.{split} = "
                    f"{self.sizes[split]} requires; the first is load {numbers[0]}"
                )

    def repair(self) -> Store:
        """Make damaged files again, also beyond the sizes wanted, and print the flaws."""
        before = {split: self.store.tried(split) for split in self.sizes}
        for path, action in repair(self.store):
            print(f"{path} {action}")
        missing = self.missing()
        for split, numbers in missing.items():
            missing[split] = sorted({*numbers, *before[split]} - self.store.tried(split))
            if missing[split]:
                print(f"{len(missing[split])} loads of {split} are missing and are solved")
        self._solve_with_progress(missing)
        return self.fill()


class LoadSolver:
    """Solves loads of a data set under progress bars, by default in the caller's thread."""

    def __init__(
        self,
        dataset: DataSet,
        loads: Iterable[tuple[str, Sequence[int]]],
        *,
        stop: object = None,
        thread: bool = False,
    ) -> None:
        """Start to solve, see `DataSet.solve`.

        With `thread`, a thread supervises the workers and writes the solved loads meanwhile.
        """
        self._dataset = dataset
        self._tried = {split: dataset.store.tried(split) for split in STREAMS}
        self._first = dict.fromkeys(STREAMS, 0)  # all loads before these have been tried
        self._done = 0  # loads of this session
        self._news = ""
        self._solved = Background(
            lambda own: self._solve(loads, own if stop is None else stop), thread=thread
        )

    def _solve(
        self, loads: Iterable[tuple[str, Sequence[int]]], stop: object
    ) -> Generator[LoadKey, None, None]:
        """Yield the keys of solved loads; append a line to the journal at the end."""
        folder, splits = self._dataset.store.folder, list(STREAMS)
        date, start = time.strftime("%Y-%m-%d %H:%M:%S"), time.perf_counter()
        accepted, core_seconds = 0, 0.0
        try:
            with closing(self._dataset.solve(loads, stop)) as solving:
                for solved in solving:
                    self._done += 1
                    accepted += solved.accepted
                    core_seconds += solved.seconds
                    rate = self._done / (time.perf_counter() - start)
                    rejected = self._done - accepted
                    self._news = f"{accepted} accepted, {rejected} rejected, {rate:.1f}/s"
                    self._tried[splits[solved.job.seed[1]]].add(solved.job.number)
                    yield solved.job
        finally:
            if self._done and folder.is_dir():
                line = {
                    "started": date,
                    "machine": socket.gethostname(),
                    "process": os.getpid(),
                    "python": platform.python_version(),
                    "dpl": __version__,
                    "workers": self._dataset.workers,
                    "loads": self._done,
                    "seconds": round(time.perf_counter() - start, 3),
                    "core_seconds": round(core_seconds, 3),
                }
                append_jsonl(folder / JOURNAL, line)

    def count(self, split: str) -> int:
        """Return the number of loads of a split before the first one that has not been tried."""
        while self._first[split] in self._tried[split]:
            self._first[split] += 1
        return self._first[split]

    def wait(
        self, sizes: Mapping[str, int], *, until: float | None = None, show: bool = False
    ) -> None:
        """Wait until the first loads of each split have been tried, or there is no load left.

        The wait ends `until` a time of `time.monotonic` [s]. Errors are those of `DataSet.solve`.
        """

        def done() -> int:
            return sum(min(self.count(split), size) for split, size in sizes.items())

        self._wait(done, sum(sizes.values()), until=until, show=show)

    def finish(self, total: int) -> None:
        """Solve all loads, `total` in number, and merge files."""
        self._wait(lambda: self._done, total or 1, show=total > 0)
        self._solved.get()  # merges the last files

    def _wait(
        self, done: Callable[[], int], wanted: int, *, show: bool, until: float | None = None
    ) -> None:
        with progress.Progress(
            progress.TextColumn("solving loads"),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn("{task.fields[news]}"),
            progress.TimeRemainingColumn(),
            refresh_per_second=2,
            disable=not show,
        ) as bars:
            bar = bars.add_task("", total=wanted, news="")
            while True:
                bars.update(bar, completed=(count := done()), news=self._news)
                left = math.inf if until is None else until - time.monotonic()
                if count >= wanted or self._solved.ended or left <= 0:
                    return
                self._solved.get(min(REFRESH, left))

    def close(self) -> None:
        """Finish the solves in progress, start no other and end the workers."""
        self._solved.close()

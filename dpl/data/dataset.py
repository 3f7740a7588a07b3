"""A data set with the sizes that are wanted, and its generation with progress and interruption."""

import hashlib
import json
import sys
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch
from rich import progress
from safetensors.torch import save

from dpl.data.solving.solve import LoadKey, SolvedLoad
from dpl.data.solving.worker_pool import GracefulShutdown, solve_loads
from dpl.data.storage.acceptance import bias_warning
from dpl.data.storage.integrity import repair, verify
from dpl.data.storage.journal import Session
from dpl.data.storage.manifest import merge_entries, read_manifest, rewrite, shard_name, tried_loads
from dpl.data.storage.pending import clean_partial_files
from dpl.data.storage.shard import concatenate
from dpl.data.storage.store import FORMAT, MODES, Store, runs
from dpl.scene import Scene
from dpl.system.checks import check_range
from dpl.system.files import append_jsonl, exclusive_lock, write_file
from dpl.version import __version__

MAX_LOADS = 10**7  # in a split
MAX_WORKERS = 1024


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
        missing = sum(len(self.store.missing(*split)) for split in self.sizes.items())
        return [("data", f"loads: {sizes}; {missing:,} of them to be solved")]

    def skipped_work(self) -> list[str]:
        """Return one line for each kind of work that is not needed."""
        wanted = sum(self.sizes.values())
        there = wanted - sum(len(self.store.missing(*split)) for split in self.sizes.items())
        same = " with these boundary values over E and L" if self.scene.has_boundary_values else ""
        sizes = "size" if self.scene.problem.follower_loads.ranges else "size and Young's modulus"
        lines = [
            f"one data set for every {sizes} of this body{same}: "
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
        self._solve_with_progress(self.missing())
        if warning := bias_warning(self.store.acceptance()):
            print(f"warning: {warning}", file=sys.stderr)
        return self.store

    def _solve_with_progress(self, missing: Mapping[str, Sequence[int]]) -> None:
        """Solve these loads, by split, under a progress bar."""
        columns = (
            progress.TextColumn("solving loads"),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn("{task.fields[news]}"),
            progress.TimeRemainingColumn(),
        )
        jobs = {
            LoadKey(self.store.stream(split), number)
            for split, numbers in missing.items()
            for number in numbers
        }
        if not jobs:
            return
        completed = len(jobs & self.store.pending.files().keys())
        session = Session(workers=self.workers)
        with GracefulShutdown() as stop, progress.Progress(*columns, refresh_per_second=2) as bars:
            bar = bars.add_task("", total=len(jobs), completed=completed, news="")
            try:
                # closed first, which ends the workers
                with closing(self.solve(missing.items(), stop)) as solving:
                    for solved in solving:
                        news = session.count(solved.accepted, solved.seconds)
                        bars.update(bar, advance=1, news=news)
            finally:
                session.append_to_journal(self.store.folder)
            stop.exit()

    @property
    def _manifest(self) -> Path:
        """Path of the manifest of this writer."""
        part = "" if self.shards == 1 else f"-{self.shard}-of-{self.shards}"
        return self.store.folder / f"manifest{part}.jsonl"

    def create(self) -> None:
        """Write `scene.json` and the modes if they are missing.

        Raises:
            DataSetError: The folder holds something else.
        """
        folder, scene = self.store.folder, self.scene
        self.store.shards()
        if (folder / "scene.json").exists():
            return
        folder.mkdir(parents=True, exist_ok=True)
        write_file(folder / MODES, save(dict(scene.loads.arrays())))
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

        Each solved load is written to a pending file at once, and a shard as soon as all its loads
        are solved, in order. Pending loads of an interrupted run are not solved again.

        Args:
            loads: Splits with numbers of loads, in the order of the solves; read when they are due.
            stop: Once its truth value is True, no further load is started.

        Raises:
            DataSetError: The folder holds something else, or another process writes there.
        """
        self.create()
        store = self.store
        with exclusive_lock(store.folder, self.shard, self.shards):
            clean_partial_files(store.folder)
            pending = store.pending.files()
            tried = {
                LoadKey(store.stream(line["split"]), number)
                for line in store.shards()
                for number in tried_loads(line)
            }
            for job in pending.keys() & tried:  # killed between writing a shard and this removal
                pending.pop(job).unlink(missing_ok=True)
            files: list[list[LoadKey]] = []  # shards whose loads have been read from `loads`

            def jobs() -> Iterator[LoadKey]:
                for split, numbers in loads:
                    key = partial(LoadKey, store.stream(split))
                    new = [number for number in numbers if key(number) not in tried]
                    for run in runs(new):
                        files.append([key(number) for number in run])
                        yield from [job for job in files[-1] if job not in pending]

            for solved in solve_loads(
                self.scene, jobs(), workers=self.workers, timeout=self.timeout, stop=stop
            ):
                pending[solved.job] = store.pending.write(solved)
                yield solved
                self._write_complete_shards(files, pending)
            self._write_complete_shards(files, pending)
            rewrite(self._manifest, read_manifest(self._manifest))
            if self.shards == 1:
                with suppress(OSError):  # it is not empty
                    store.pending.folder.rmdir()

    def _write_complete_shards(
        self, files: list[list[LoadKey]], pending: dict[LoadKey, Path]
    ) -> None:
        """Write the first shards whose loads are all pending; remove them from both arguments."""
        while files and all(job in pending for job in files[0]):
            paths = [pending.pop(job) for job in files.pop(0)]
            entries, columns = zip(*map(self.store.pending.read, paths), strict=True)
            entry, content = merge_entries(entries), save(concatenate(columns))
            name = shard_name(entry["split"], entry["first"])
            write_file(self.store.folder / name, content)
            sha256 = hashlib.sha256(content).hexdigest()
            append_jsonl(self._manifest, {"file": name, "sha256": sha256, **entry})
            for path in paths:  # a writer that starts now also removes loads that have a shard
                path.unlink(missing_ok=True)

    def verify(self) -> Iterator[str]:
        """Yield one line for each flaw of the data set, and for missing loads.

        Raises:
            DataSetError: There is no data set.
        """
        files = len(self.store.shards()) + 1
        for part, flaw in progress.track(verify(self.store), "verifying files", total=files):
            if flaw:
                yield f"{self.store.folder / part.file} {flaw}"
        for split, numbers in self.missing().items():
            if numbers:
                yield (
                    f"{self.store.folder} lacks {len(numbers)} of the loads that data.{split} = "
                    f"{self.sizes[split]} requires; the first is load {numbers[0]}"
                )

    def repair(self) -> Store:
        """Make damaged files again, also beyond the sizes wanted, and print the flaws."""
        flaws = repair(self.store)
        missing = self.missing()
        for part, action in flaws:
            print(f"{self.store.folder / part.file} {action}")
            if part.split:
                missing[part.split] = sorted({*missing[part.split], *part.loads})
        for split, numbers in missing.items():
            if numbers:
                print(f"{len(numbers)} loads of {split} are missing and are solved")
        self._solve_with_progress(missing)
        return self.fill()

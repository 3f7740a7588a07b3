"""Writing a data set: solved loads become pending files, and these become shards, in order."""

import hashlib
import json
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save

from dpl.data.solving.solve import LoadKey, SolvedLoad
from dpl.data.solving.worker_pool import GracefulShutdown, solve_loads
from dpl.data.storage.manifest import merge_entries, read_manifest, shard_name, sort_key
from dpl.data.storage.pending import clean_partial_files
from dpl.data.storage.shard import concatenate
from dpl.data.storage.store import FORMAT, MODES, Store, runs
from dpl.system.files import append_jsonl, exclusive_lock, write_file
from dpl.version import __version__


@dataclass(frozen=True)
class Writer:
    """One of the processes that write to a data set.

    Attributes:
        store: The data set.
        shard: Index of this writer.
        shards: Number of writers, who take the files in turn.
    """

    store: Store
    shard: int = 0
    shards: int = 1

    @property
    def manifest(self) -> Path:
        """Path of the manifest of this writer."""
        part = "" if self.shards == 1 else f"-{self.shard}-of-{self.shards}"
        return self.store.folder / f"manifest{part}.jsonl"

    def create(self) -> None:
        """Write `scene.json` and the modes if they are missing.

        Raises:
            DataSetError: The folder holds something else.
        """
        folder, scene = self.store.folder, self.store.scene
        self.store.shards()
        if (folder / "scene.json").exists():
            return
        folder.mkdir(parents=True, exist_ok=True)
        write_file(folder / MODES, save(dict(scene.loads.arrays())))
        card = {
            "format": FORMAT,
            "fingerprint": scene.fingerprint,
            "scene": scene.identity(),
            "seed": self.store.seed,
            "versions": {
                "dpl": __version__,
                "torch": torch.__version__,
                "numpy": np.__version__,
            },
        }
        write_file(folder / "scene.json", json.dumps(card, indent=1).encode())

    def fill(
        self,
        missing: Mapping[str, Sequence[int]],
        *,
        workers: int,
        timeout: float | None = None,
        stop: GracefulShutdown | None = None,
    ) -> Generator[SolvedLoad, None, None]:
        """Solve missing loads; yield each as soon as it is solved.

        Each solved load is written to a pending file at once, and a shard as soon as all its loads
        are solved, in order. Pending loads of an interrupted run are not solved again.

        Args:
            missing: Numbers of the loads, by split.
            workers: Number of processes that solve; 0: solve in this process.
            timeout: Time limit for a load [s].
            stop: Once it is true, no further load is started.

        Raises:
            DataSetError: The folder holds something else, or another process writes there.
        """
        self.create()
        store = self.store
        with exclusive_lock(store.folder, self.shard, self.shards):
            clean_partial_files(store.folder)
            pending, tried = store.pending.files(), store.tried()
            for job in pending.keys() & tried:  # killed between writing a shard and this removal
                pending.pop(job).unlink(missing_ok=True)
            files = [
                [LoadKey(store.stream(split), number) for number in run]
                for split, numbers in missing.items()
                for run in runs(
                    [k for k in numbers if LoadKey(store.stream(split), k) not in tried]
                )
            ]
            jobs = [job for file in files for job in file if job not in pending]
            self._write_complete_shards(files, pending)
            for solved in solve_loads(
                store.scene, jobs, workers=workers, timeout=timeout, stop=stop
            ):
                pending[solved.job] = store.pending.write(solved)
                yield solved
                self._write_complete_shards(files, pending)
            rewrite(self.manifest, read_manifest(self.manifest))
            if self.shards == 1:
                store.pending.remove_if_empty()

    def collect(self, split: str) -> None:
        """Write the pending loads of a split that make whole shards.

        Raises:
            DataSetError: Another process writes there.
        """
        store = self.store
        with exclusive_lock(store.folder, self.shard, self.shards):
            pending = store.pending.files()
            mine = {job for job in pending if job.seed == store.stream(split)}
            count = max((job.number for job in mine), default=-1) + 1
            found = runs(store.missing(split, count), whole=True)
            files = [[LoadKey(store.stream(split), number) for number in run] for run in found]
            self._write_complete_shards([file for file in files if mine.issuperset(file)], pending)

    def _write_complete_shards(
        self, files: list[list[LoadKey]], pending: dict[LoadKey, Path]
    ) -> None:
        """Write the first shards whose loads are all pending; remove them from both arguments."""
        while files and all(job in pending for job in files[0]):
            paths = [pending.pop(job) for job in files.pop(0)]
            self._write_shard(paths)
            for path in paths:  # a writer that starts now also removes loads that have a shard
                path.unlink(missing_ok=True)

    def _write_shard(self, paths: Sequence[Path]) -> None:
        """Write a shard of pending loads, then its line of the manifest."""
        entries, columns = zip(*map(self.store.pending.read, paths), strict=True)
        entry, content = merge_entries(entries), save(concatenate(columns))
        name = shard_name(entry["split"], entry["first"])
        write_file(self.store.folder / name, content)
        sha256 = hashlib.sha256(content).hexdigest()
        append_jsonl(self.manifest, {"file": name, "sha256": sha256, **entry})


def rewrite(manifest: Path, lines: Sequence[dict[str, Any]]) -> None:
    """Write these lines, sorted, to a manifest that exists and differs."""
    text = "".join(json.dumps(line) + "\n" for line in sorted(lines, key=sort_key)).encode()
    if manifest.exists() and manifest.read_bytes() != text:
        write_file(manifest, text)

"""Writing a data set: loads are solved into the spool, and from there into shards, in order."""

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
from dpl.data.storage.manifest import STREAMS, lines_of, place, shard_name
from dpl.data.storage.pending import clean_partial_files
from dpl.data.storage.shard import encode_shard
from dpl.data.storage.store import FORMAT, MODES, Store, runs
from dpl.system.files import append_jsonl, exclusive_lock, write_file
from dpl.version import __version__


@dataclass(frozen=True)
class Writer:
    """One who writes to a data set, alone or beside others.

    Attributes:
        store: The data set.
        shard: Which files are its own, of
        shards: so many writers, who take files in turn.
    """

    store: Store
    shard: int = 0
    shards: int = 1

    @property
    def manifest(self) -> Path:
        """Where it names its shards."""
        alone = self.shards == 1
        name = "manifest" if alone else f"manifest-{self.shard}-of-{self.shards}"
        return self.store.folder / f"{name}.jsonl"

    def create(self) -> None:
        """Write down whose data set this is, if it is not there yet.

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
        """Solve loads that are missing, by split; yield each as it is done.

        Each is kept in the spool as soon as it is solved; a shard is written when it is complete,
        in order. Loads that were spooled before an interruption are not solved again.

        Args:
            missing: Numbers of the loads, by split.
            workers: Processes that solve; 0: this one.
            timeout: Longest time for a load [s].
            stop: Asked whether to begin no more.

        Raises:
            DataSetError: The folder holds something else, or another process writes there.
        """
        self.create()
        store = self.store
        with exclusive_lock(store.folder, self.shard, self.shards):
            clean_partial_files(store.folder)
            spooled, tried = store.pending.files(), store.tried()
            for job in [*spooled]:
                if job in tried:  # killed between writing its shard and removing it
                    spooled.pop(job).unlink(missing_ok=True)
            wanted = {
                split: [i for i in indices if LoadKey(store.stream(split), i) not in tried]
                for split, indices in missing.items()
            }
            files = [
                [LoadKey(store.stream(split), index) for index in run]
                for split, indices in wanted.items()
                for run in runs(indices)
            ]
            jobs = [job for file in files for job in file if job not in spooled]
            self._flush(files, spooled)
            for one in solve_loads(store.scene, jobs, workers=workers, timeout=timeout, stop=stop):
                spooled[one.job] = store.pending.put(one)
                yield one
                self._flush(files, spooled)
            rewrite(self.manifest, lines_of(self.manifest))
            if self.shards == 1:
                store.pending.clean()

    def _split(self, job: LoadKey) -> str:
        return {self.store.stream(name): name for name in STREAMS}[job.seed]

    def _flush(self, files: list[list[LoadKey]], spooled: dict[LoadKey, Path]) -> None:
        """Write the first shards that are complete; take them off both lists."""
        while files and all(job in spooled for job in files[0]):
            jobs = files.pop(0)
            paths = [spooled.pop(job) for job in jobs]
            self._append([self.store.pending.get(path) for path in paths])
            for path in paths:
                path.unlink()

    def collect(self, split: str) -> None:
        """Write those spooled loads of a split that make whole shards.

        Raises:
            DataSetError: Another process writes there.
        """
        store = self.store
        with exclusive_lock(store.folder, self.shard, self.shards):
            spooled = store.pending.files()
            mine = {job for job in spooled if job.seed == store.stream(split)}
            count = max((job.number for job in mine), default=-1) + 1
            found = runs(store.missing(split, count), whole=True)
            files = [[LoadKey(store.stream(split), index) for index in run] for run in found]
            self._flush([file for file in files if mine.issuperset(file)], spooled)

    def _append(self, tried: Sequence[SolvedLoad]) -> None:
        """Write one shard, then its line of the manifest."""
        split, first = self._split(tried[0].job), tried[0].job.number
        kept = [one for one in tried if one.accepted]
        name = shard_name(split, first)
        scene, loads = self.store.scene, self.store.scene.loads
        poisson = None if loads.poisson_range is None else loads.poisson_at
        content = encode_shard(kept, scene.problem.shape, loads.n_random, poisson)
        write_file(self.store.folder / name, content)
        line = {
            "file": name,
            "sha256": hashlib.sha256(content).hexdigest(),
            "split": split,
            "first": first,
            "tried": len(tried),
            "accepted": len(kept),
            "iterations": sum(one.iterations for one in tried),
            "amplitudes": [round(one.amplitude, 6) for one in tried],
            "rejected": [
                {"index": one.job.number, "reason": one.reason, "load_factor": one.load_factor}
                for one in tried
                if not one.accepted
            ],
        }
        append_jsonl(self.manifest, line)


def rewrite(manifest: Path, lines: Sequence[dict[str, Any]]) -> None:
    """Make a manifest of these lines, in order, if it is not that already."""
    text = "".join(json.dumps(line) + "\n" for line in sorted(lines, key=place)).encode()
    if manifest.exists() and manifest.read_bytes() != text:
        write_file(manifest, text)

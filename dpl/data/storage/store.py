"""Data set on disk: immutable safetensors shards and manifests that name them.

    FOLDER/scene.json            fingerprint of the scene with its fields, seed, versions
    FOLDER/modes.safetensors     eigenvalues and eigenvectors that the loads are made of
    FOLDER/train-000000.safetensors, ...
    FOLDER/manifest.jsonl        one line per shard: name, SHA-256, loads tried, rejected loads
    FOLDER/manifest-1-of-4.jsonl the same of one of several writers
    FOLDER/journal.jsonl         one line per session: date, machine, duration
    FOLDER/pending/              solved loads whose shard is not complete, one file each

A shard that no manifest names is ignored. The same loads give the same bytes for any number of
workers and after any interruption.
"""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from dpl.data.storage.acceptance import AmplitudeBin, acceptance_table, amplitude_bins
from dpl.data.storage.journal import read_sessions
from dpl.data.storage.manifest import STREAMS, accepted_loads, read_manifest, sort_key, tried_loads
from dpl.data.storage.pending import PendingLoads
from dpl.data.storage.shard import Columns, decode_shard, to_dense
from dpl.scene import Sample, Scene
from dpl.system.files import DataSetError, read_regular_file

FORMAT = 4
MODES = "modes.safetensors"
HEADER = 100_000  # largest size of a shard without its numbers [bytes]
SHARD_SIZE = 64  # loads in one file


@dataclass(frozen=True)
class Store:
    """Data set of one scene and one seed.

    Attributes:
        folder: Folder of the data set; need not exist.
        scene: Scene of the loads.
        seed: Seed of the loads.
    """

    folder: Path
    scene: Scene
    seed: int

    def stream(self, split: str) -> tuple[int, int]:
        """Return the seed of the loads of a split."""
        return self.seed, STREAMS[split]

    @property
    def pending(self) -> PendingLoads:
        """Solved loads whose shard is not complete."""
        streams = {name: self.stream(name) for name in STREAMS}
        return PendingLoads(self.folder / "pending", streams, self.scene.loads.parameters_at)

    def shards(self) -> list[dict[str, Any]]:
        """Return the lines of all manifests, sorted; empty if there is no data set yet.

        Raises:
            DataSetError: The folder holds something else.
        """
        card = self.folder / "scene.json"
        if self.folder.exists() and not self.folder.is_dir():
            raise DataSetError(f"data.folder = {self.folder} must be a folder; choose another")
        names = {path.name for path in self.folder.iterdir()} if self.folder.exists() else set()
        if card.name not in names:
            if {name for name in names if name[0] != "."} <= {MODES}:
                return []
            raise DataSetError(
                f"{self.folder} is not empty and no data set; choose another data.folder"
            )
        try:
            self._check(json.loads(read_regular_file(card)))
        except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
            if isinstance(error, DataSetError):
                raise
            raise DataSetError(
                f"{card} is damaged ({error}); choose another data.folder or remove this one"
            ) from None
        lines = [line for path in self.manifests() for line in read_manifest(path)]
        return sorted(lines, key=sort_key)

    def manifests(self) -> list[Path]:
        """Return the paths of the manifests of all writers."""
        return sorted(self.folder.glob("manifest*.jsonl"))

    def _check(self, card: dict[str, Any]) -> None:
        """Raise DataSetError if the data set is one of another format, scene or seed."""
        if card.get("format") != FORMAT:
            raise DataSetError(
                f"{self.folder} has format {card.get('format')}, this dpl reads {FORMAT}; "
                "choose another data.folder"
            )
        same = card["fingerprint"] == self.scene.fingerprint
        if not same and not self.scene.matches(card["scene"]):
            found = self.scene.differences(card["scene"]) or ["written by another version"]
            raise DataSetError(
                f"{self.folder} is a data set of another scene: its fingerprint is "
                f"{card['fingerprint'][:12]}, this scene's is {self.scene.fingerprint[:12]} "
                f"({'; '.join(found)}); choose another data.folder or restore the scene"
            )
        if card["seed"] != self.seed:
            raise DataSetError(
                f"{self.folder} was drawn with seed {card['seed']}, not {self.seed}; "
                "choose another data.folder or data.seed"
            )

    def missing(self, split: str, count: int, shard: int = 0, shards: int = 1) -> list[int]:
        """Return which of the first `count` loads of a split have not been tried.

        Of several writers `shards`, who take blocks of `SHARD_SIZE` loads in turn, only the loads
        of writer `shard` are returned.
        """
        tried = {number for line in self._shards_of(split) for number in tried_loads(line)}
        return [
            number
            for number in range(count)
            if number // SHARD_SIZE % shards == shard and number not in tried
        ]

    def _shards_of(self, split: str) -> list[dict[str, Any]]:
        return [line for line in self.shards() if line["split"] == split]

    def load(self, split: str, count: int, first: int = 0) -> Sample:
        """Return the accepted ones of loads `first` to `count` - 1 of a split, in order.

        Another thread or process may solve loads of the data set at the same time.

        Raises:
            DataSetError: A shard is damaged, or there are no samples.
        """
        parts = self._pending_columns(split, first, count)  # before the shards that take them
        parts += [
            self._read_shard(line)
            for line in self._shards_of(split)
            if line["first"] < count and tried_loads(line).stop > first
        ]
        number = np.concatenate([np.zeros(0, int), *(part["index"].numpy() for part in parts)])
        rows = np.unique(number, return_index=True)[1]  # two writers may have solved the same load
        rows = rows[(first <= number[rows]) & (number[rows] < count)]
        if not len(rows):
            raise DataSetError(f"{self.folder} holds no {split} samples")
        force = torch.cat([to_dense(part, self.scene.problem.shape) for part in parts])[rows]
        displacement, point, parameters = (
            torch.cat([part[name] for part in parts])[rows]
            for name in ("displacement", "point", "parameters")
        )
        return Sample(force, displacement, self.scene.loads.young_at(point), parameters)

    def _pending_columns(self, split: str, first: int, count: int) -> list[Columns]:
        """Return the columns of the pending ones of loads `first` to `count` - 1."""
        found = []
        for job, path in self.pending.files().items():
            if job.seed == self.stream(split) and first <= job.number < count:
                with suppress(FileNotFoundError):  # its writer has moved it into a shard
                    found.append(self.pending.read(path)[1])
        return found

    def tried(self, split: str) -> set[int]:
        """Return the loads of a split that have been tried, in shards or pending."""
        # pending loads first, since another thread or process may move them into shards
        pending = {job.number for job in self.pending.files() if job.seed == self.stream(split)}
        return pending.union(*map(tried_loads, self._shards_of(split)))

    def _read_shard(self, line: Mapping[str, Any]) -> Columns:
        """Return the columns of a shard; raise DataSetError if it is damaged."""
        try:
            return self.read_shard(line)
        except ValueError as error:
            raise DataSetError(
                f"{self.folder / line['file']} {error}; scripts/generate.py action=repair with the "
                "same scene solves its loads again"
            ) from None

    def read_shard(self, line: Mapping[str, Any]) -> Columns:
        """Return the columns of a shard; raise ValueError if it is damaged, see `decode_shard`."""
        path = self.folder / line["file"]
        if path.parent != self.folder:
            raise ValueError("is not in the folder of the data set and is not read")
        if path.is_symlink() or not path.is_file():
            raise ValueError("is missing")
        if path.stat().st_size > self.max_shard_size(line["tried"]):
            raise ValueError("is damaged: it is larger than its loads")
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != line["sha256"]:
            raise ValueError("is damaged: its SHA-256 differs from the manifest's")
        shard = self.decode(content)
        if shard["index"].tolist() != accepted_loads(line):
            raise ValueError("holds other loads than its line of the manifest")
        return shard

    def max_shard_size(self, loads: int) -> int:
        """Return the largest possible size of a shard of this many loads [bytes]."""
        numbers = 3 * math.prod(self.scene.problem.shape) + self.scene.loads.n_random + 8
        return HEADER + 8 * numbers * loads

    def decode(self, content: bytes) -> Columns:
        """Return the columns of a shard of this scene, see `decode_shard`."""
        loads = self.scene.loads
        shape, n_parameters = self.scene.problem.shape, len(loads.parameter_ranges)
        return decode_shard(content, shape, loads.n_random, n_parameters)

    def digest(self, split: str, count: int) -> str:
        """Return the SHA-256 of the samples of a split; it does not depend on the shard size."""
        found = hashlib.sha256()
        for column in self.load(split, count)[:2]:
            found.update(column.contiguous().numpy().tobytes())
        return found.hexdigest()

    def modes(self) -> dict[str, Tensor]:
        """Return the stored `LoadFamily.arrays`; raise DataSetError if their file is damaged."""
        path = self.folder / MODES
        expected = self.scene.loads.arrays()
        most = HEADER + 16 * sum(array.numel() for array in expected.values())
        try:
            found = load(read_regular_file(path, most))
            return {name: found[name] for name in expected}
        except (FileNotFoundError, KeyError, SafetensorError, ValueError) as error:
            raise DataSetError(
                f"{path} is damaged: {error}; scripts/generate.py action=repair makes it again"
            ) from None

    def acceptance(self) -> list[AmplitudeBin]:
        """Return the numbers of tried and accepted loads by amplitude, over all splits."""
        lines = self.shards()
        amplitudes = [amplitude for line in lines for amplitude in line["amplitudes"]]
        kept = (np.isin(tried_loads(line), accepted_loads(line)) for line in lines)
        return amplitude_bins(amplitudes, np.concatenate([np.zeros(0, bool), *kept]).tolist())

    def summary(self) -> str:
        """Return a table of tried and accepted loads, by split and by amplitude."""
        lines = [str(self.folder)]
        for split in STREAMS:
            shards = self._shards_of(split)
            tried, accepted, iterations = (
                sum(line[key] for line in shards) for key in ("tried", "accepted", "iterations")
            )
            if tried:
                lines.append(
                    f"  {split}: {accepted} of {tried} loads accepted, "
                    f"{iterations / tried:.1f} Newton iterations"
                )
        lines += [f"  {row}" for row in acceptance_table(self.acceptance())]
        sessions = read_sessions(self.folder)
        loads, wall, core = (
            sum(one[key] for one in sessions) for key in ("loads", "seconds", "core_seconds")
        )
        if loads:
            size = sum(path.lstat().st_size for path in self.folder.glob("*.safetensors")) / 1e6
            lines.append(
                f"  {core / loads:.3f} s per load on one core, {wall:.0f} s of wall time in "
                f"{len(sessions)} sessions, {size:.0f} MB"
            )
        return "\n".join(lines)

    def seconds_per_load(self) -> float | None:
        """Return the mean wall time per load over all sessions [s]; None before the first one."""
        sessions = read_sessions(self.folder)
        loads = sum(one["loads"] for one in sessions)
        return sum(one["seconds"] for one in sessions) / loads if loads else None


def runs(numbers: Sequence[int]) -> Iterator[list[int]]:
    """Yield the loads of each file, of `numbers` in ascending order.

    They are consecutive and never across a multiple of SHARD_SIZE.
    """
    run: list[int] = []
    for number in [*numbers, None]:
        if run and (number is None or number != run[-1] + 1 or number % SHARD_SIZE == 0):
            yield run
            run = []
        if number is not None:
            run.append(number)

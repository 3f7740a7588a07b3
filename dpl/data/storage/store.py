"""Data set on disk: safetensors shards of solved loads.

    FOLDER/scene.json            fingerprint of the scene with its fields, seed, versions
    FOLDER/train-000000.safetensors, ...  solved loads, named by the first one
    FOLDER/journal.jsonl         one line per session: date, machine, duration

A solved load is written to a file of its own at once. Files of one block of `SHARD_SIZE` loads are
merged when its loads have been tried. The same loads give the same bytes for any number of workers
and after any interruption.
"""

import json
import math
import re
import stat
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpl.data.solving.solve import SolvedLoad
from dpl.data.storage.shard import (
    REASON,
    Columns,
    encode_load,
    encode_shard,
    read_shard,
    reasons,
    single_loads,
    to_dense,
)
from dpl.scene import Sample, Scene
from dpl.system.files import DataSetError, read_jsonl, read_regular_file, write_file

FORMAT = 5
JOURNAL = "journal.jsonl"
MAX_DURATION = 1e15  # of a session in a journal, and its number of loads
STREAMS = {"train": 0, "val": 1, "test": 2}  # disjoint streams of one seed
SHARD_NAME = re.compile(rf"({'|'.join(STREAMS)})-(\d{{6,16}})\.safetensors")
HEADER = 100_000  # largest size of a shard without its numbers [bytes]
SHARD_SIZE = 64  # loads in one block, and at most in one file
BINS = 10  # of amplitudes
MIN_ACCEPTANCE = 0.9  # accepted fraction of a bin below which the data set is biased
MIN_LOADS = 10  # tried loads below which a bin is not judged


class AmplitudeBin(NamedTuple):
    """Numbers of loads in a range of amplitudes ||f|| / ||Phi q_max|| [-]."""

    low: float
    high: float
    tried: int
    accepted: int

    @property
    def biased(self) -> bool:
        """True if too large a fraction of the loads was rejected."""
        return self.tried >= MIN_LOADS and self.accepted < MIN_ACCEPTANCE * self.tried


class Shard(NamedTuple):
    """A file of solved loads: its path, its split, and its columns of `shard.DESCRIPTION`."""

    path: Path
    split: str
    columns: Columns

    @property
    def tried(self) -> list[int]:
        """Numbers of its loads, accepted or rejected."""
        return self.columns["tried"].tolist()

    @property
    def accepted(self) -> Tensor:
        """Mask of the accepted loads among `tried`, (T,)."""
        return torch.isin(self.columns["tried"], self.columns["index"])


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

    def exists(self) -> bool:
        """Return True if the folder holds the data set, False if nothing is there; else raise."""
        card = self.folder / "scene.json"
        if self.folder.exists() and not self.folder.is_dir():
            raise DataSetError(f"data.folder = {self.folder} must be a folder; choose another")
        names = {path.name for path in self.folder.iterdir()} if self.folder.exists() else set()
        if card.name not in names:
            if all(name[0] == "." for name in names):
                return False
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
        return True

    def files(self) -> list[Path]:
        """Return the files that are or could be shards."""
        return sorted(
            path for split in STREAMS for path in self.folder.glob(f"{split}-*.safetensors")
        )

    def shards(self, split: str | None = None, block: int | None = None) -> list[Shard]:
        """Return the shards, of one split or of one block; files that are none are left out."""
        while self.exists():
            found = []
            with suppress(FileNotFoundError):  # another writer merges files: read them again
                for path in self.files():
                    name = SHARD_NAME.fullmatch(path.name)
                    if not name or split not in (None, name[1]):
                        continue
                    if block in (None, int(name[2]) // SHARD_SIZE):
                        with suppress(ValueError):  # damaged; `verify` reports it
                            found.append(self.describe(path))
                return found
        return []

    def describe(self, path: Path) -> Shard:
        """Return a shard without its solutions; raise ValueError if it is damaged."""
        self._check_file(path)
        name, columns = SHARD_NAME.fullmatch(path.name), read_shard(path)
        if name is None or int(name[2]) != columns["tried"][0]:
            raise ValueError("has another name than that of its first load")
        return Shard(path, name[1], columns)

    def read(self, path: Path) -> Columns:
        """Return the columns of a shard; raise ValueError if it is damaged, see `read_shard`."""
        self._check_file(path)
        shape, loads = self.scene.problem.shape, self.scene.loads
        return read_shard(path, shape, loads.n_random, len(loads.parameter_ranges))

    def _check_file(self, path: Path) -> None:
        status = path.lstat()
        if not stat.S_ISREG(status.st_mode):
            raise ValueError("is not a regular file (symbolic links are refused)")
        if status.st_size > self.max_shard_size(SHARD_SIZE):
            raise ValueError("is damaged: it is larger than its loads")

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
        """Return the numbers of the loads below `count` that one writer has to solve.

        The writers, `shards` in number and this one the number `shard`, take blocks of `SHARD_SIZE`
        loads of a split in turn.
        """
        tried = self.tried(split)
        return [
            number
            for number in range(count)
            if number // SHARD_SIZE % shards == shard and number not in tried
        ]

    def tried(self, split: str) -> set[int]:
        """Return the loads of a split that have been tried."""
        return {number for shard in self.shards(split) for number in shard.tried}

    def load(self, split: str, count: int, first: int = 0) -> Sample:
        """Return the accepted ones of loads `first` to `count` - 1 of a split, in order.

        Another thread or process may solve loads of the data set at the same time.
        """
        while True:
            parts = []
            with suppress(FileNotFoundError):  # another writer merges files: read them again
                for shard in self.shards(split):
                    if any(first <= number < count for number in shard.tried):
                        try:
                            parts.append(self.read(shard.path))
                        except ValueError as error:
                            raise DataSetError(
                                f"{shard.path} {error}; scripts/generate.py action=repair with the "
                                "same scene solves its loads again"
                            ) from None
                break
        number = np.concatenate([np.zeros(0, int), *(part["index"].numpy() for part in parts)])
        # a load may be in two files if a writer was killed while it merged them
        rows = np.unique(number, return_index=True)[1]
        rows = rows[(first <= number[rows]) & (number[rows] < count)]
        if not len(rows):
            raise DataSetError(f"{self.folder} holds no {split} samples")
        force = torch.cat([to_dense(part, self.scene.problem.shape) for part in parts])[rows]
        displacement, point, parameters = (
            torch.cat([part[name] for part in parts])[rows]
            for name in ("displacement", "point", "parameters")
        )
        return Sample(force, displacement, self.scene.loads.young_at(point), parameters)

    def write(self, solved: SolvedLoad) -> None:
        """Write a solved load to a file of its own."""
        split = list(STREAMS)[solved.job.seed[1]]
        path = self.folder / f"{split}-{solved.job.number:06d}.safetensors"
        point = torch.from_numpy(solved.point)[None]
        columns = encode_load(solved, self.scene.loads.parameters_at(point))
        # not synced: a file that a crash of the machine has damaged is not read
        write_file(path, encode_shard(path.name, [columns]), sync=False)

    def scattered(self, shard: int = 0, shards: int = 1) -> list[tuple[str, int]]:
        """Return the blocks of a writer with more than one file, as split and number."""
        names = filter(None, (SHARD_NAME.fullmatch(path.name) for path in self.files()))
        count = Counter((name[1], int(name[2]) // SHARD_SIZE) for name in names)
        return [key for key, files in count.items() if files > 1 and key[1] % shards == shard]

    def merge(self, split: str, block: int) -> None:
        """Merge the files of a block; leave them as they are if one of them is damaged."""
        found = self.shards(split, block)
        if len(found) < 2:
            return
        loads: dict[int, Columns] = {}
        for shard in found:
            try:
                loads |= single_loads(self.read(shard.path))
            except ValueError:
                return
        path = self.folder / f"{split}-{min(loads):06d}.safetensors"
        write_file(path, encode_shard(path.name, [loads[number] for number in sorted(loads)]))
        for shard in found:
            if shard.path != path:
                shard.path.unlink(missing_ok=True)

    def max_shard_size(self, loads: int) -> int:
        """Return the largest possible size of a shard of this many loads [bytes]."""
        numbers = 3 * math.prod(self.scene.problem.shape) + 2 * self.scene.loads.n_random + 16
        return HEADER + (8 * numbers + REASON) * loads

    def acceptance(self) -> list[AmplitudeBin]:
        """Return the numbers of tried and accepted loads by amplitude, over all splits."""
        shards = self.shards()
        amplitudes = [value for shard in shards for value in shard.columns["amplitude"].tolist()]
        return amplitude_bins(amplitudes, [one for s in shards for one in s.accepted.tolist()])

    def summary(self) -> str:
        """Return a table of tried and accepted loads, by split and by amplitude."""
        lines = [str(self.folder)]
        for split in STREAMS:
            shards = self.shards(split)
            if tried := sum(len(shard.tried) for shard in shards):
                accepted = sum(int(shard.accepted.sum()) for shard in shards)
                iterations = sum(int(shard.columns["iterations"].sum()) for shard in shards)
                lines.append(
                    f"  {split}: {accepted} of {tried} loads accepted, "
                    f"{iterations / tried:.1f} iterations"
                )
        rejected = Counter(one for shard in self.shards() for one in reasons(shard.columns))
        lines += [f"  {count} rejected: {reason}" for reason, count in sorted(rejected.items())]
        lines += [f"  {row}" for row in acceptance_table(self.acceptance())]
        sessions, loads, wall, core = self._totals()
        if loads:
            size = sum(path.lstat().st_size for path in self.folder.glob("*.safetensors")) / 1e6
            lines.append(
                f"  {core / loads:.3f} s per load on one core, {wall:.0f} s of wall time in "
                f"{sessions} sessions, {size:.0f} MB"
            )
        return "\n".join(lines)

    def seconds_per_load(self) -> float | None:
        """Return the mean wall time per load over all sessions [s]; None before the first one."""
        _, loads, seconds, _ = self._totals()
        return seconds / loads if loads else None

    def _totals(self) -> tuple[int, float, float, float]:
        """Return numbers of sessions and of loads, wall time and core time of the journal [s].

        Lines that do not give these numbers are left out.
        """
        keys = "loads", "seconds", "core_seconds"
        lines = read_jsonl(self.folder / JOURNAL)
        rows: list[list[Any]] = [[line.get(key) for key in keys] for line in lines]
        valid = [
            row
            for row in rows
            if all(type(one) in (int, float) and 0 <= one < MAX_DURATION for one in row)
        ]
        loads, wall, core = (sum(row[k] for row in valid) for k in range(len(keys)))
        return len(valid), loads, wall, core


def blocks(numbers: Iterable[int]) -> Iterator[tuple[int, list[int]]]:
    """Yield the blocks of some loads in ascending order, each with its number and these loads."""
    for block, members in groupby(numbers, lambda number: number // SHARD_SIZE):
        yield block, list(members)


def amplitude_bins(amplitudes: Sequence[float], accepted: Sequence[bool]) -> list[AmplitudeBin]:
    """Return the bins of equal width from 0 to the largest amplitude that are not empty."""
    if not len(amplitudes):
        return []
    limits = (0.0, max(amplitudes) or 1.0)
    tried, edges = np.histogram(amplitudes, BINS, limits)
    kept, _ = np.histogram(np.asarray(amplitudes)[np.asarray(accepted)], BINS, limits)
    bins = zip(edges[:-1].tolist(), edges[1:].tolist(), tried.tolist(), kept.tolist(), strict=True)
    return [AmplitudeBin(*part) for part in bins if part[2]]


def acceptance_table(bins: Sequence[AmplitudeBin]) -> list[str]:
    """Return two lines of text, if there are bins: their upper limits, accepted of tried loads."""
    if not bins:
        return []
    rows = {
        "amplitude up to": [f"{part.high:.2f}" for part in bins],
        "accepted": [f"{part.accepted}/{part.tried}" for part in bins],
    }
    width = max(len(text) for row in rows.values() for text in row)
    cells = {name: "".join(f"  {text:>{width}}" for text in row) for name, row in rows.items()}
    return [f"{name:>15}{row}" for name, row in cells.items()]


def bias_warning(bins: Sequence[AmplitudeBin]) -> str:
    """Return a warning for the bin with the lowest acceptance; empty if no bin is biased."""
    biased = [part for part in bins if part.biased]
    if not biased:
        return ""
    worst = min(biased, key=lambda part: part.accepted / part.tried)
    return (
        f"the data set is biased: only {worst.accepted} of {worst.tried} loads with amplitudes "
        f"{worst.low:.2f} to {worst.high:.2f} were accepted; lower loads.deflection, or "
        "read the reasons in the summary of scripts/generate.py"
    )

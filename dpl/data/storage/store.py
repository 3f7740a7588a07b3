"""The data set on disk: immutable safetensors shards and a manifest that names them.

    FOLDER/scene.json            fingerprint of the scene with its fields, seed, versions
    FOLDER/modes.safetensors     eigenvalues and eigenvectors that the loads are made of
    FOLDER/train-000000.safetensors, ...
    FOLDER/manifest.jsonl        a line a shard: name, SHA-256, loads tried, rejects with reasons
    FOLDER/manifest-1-of-4.jsonl the same of one writer of several
    FOLDER/journal.jsonl         a line a session: when, where, how long
    FOLDER/spool/                loads solved whose shard is not complete, a file each

Files are written beside their place, synced and renamed; a shard that no manifest names does not
exist. The manifest holds nothing that depends on a clock: interrupted and resumed, by one worker or
by eight, the same loads give the same bytes.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from dpl.data.solving.solve import LoadKey, SolvedLoad
from dpl.data.storage import acceptance as balance
from dpl.data.storage.manifest import STREAMS, is_number, kept_in, lines_of, place
from dpl.data.storage.pending import PendingSamples
from dpl.data.storage.shard import decode_shard, select
from dpl.scene import Sample, Scene
from dpl.system.files import DataSetError, read_jsonl, read_regular_file

FORMAT = 2
MODES = "modes.safetensors"
HEADER = 100_000  # bytes of a shard besides its numbers, at most
SHARD = 64  # loads in one file


@dataclass(frozen=True)
class Store:
    """A data set of one scene and one seed.

    Attributes:
        folder: Where it is, or will be.
        scene: What it must be a data set of.
        seed: Names its loads.
    """

    folder: Path
    scene: Scene
    seed: int

    def stream(self, split: str) -> tuple[int, int]:
        """Return the seed of a split's loads."""
        return self.seed, STREAMS[split]

    @property
    def pending(self) -> PendingSamples:
        """The loads that are solved and wait for their shard."""
        return PendingSamples(self.folder / "spool", {name: self.stream(name) for name in STREAMS})

    def shards(self) -> list[dict[str, Any]]:
        """Return the lines of all manifests by first load; none if there is no data set yet.

        Raises:
            DataSetError: The folder holds something else.
        """
        card = self.folder / "scene.json"
        if self.folder.exists() and not self.folder.is_dir():
            raise DataSetError(f"data.folder = {self.folder} must be a folder; choose another")
        there = {path.name for path in self.folder.iterdir()} if self.folder.exists() else set()
        if card.name not in there:
            if not {name for name in there if name[0] != "."} <= {MODES}:
                raise DataSetError(
                    f"{self.folder} is not empty and no data set; choose another data.folder"
                )
            return []
        try:
            self._check(json.loads(read_regular_file(card)))
        except DataSetError:
            raise
        except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
            raise DataSetError(
                f"{card} is damaged ({error}); choose another data.folder or remove this one"
            ) from None
        lines = [line for path in self.manifests() for line in lines_of(path)]
        return sorted(lines, key=place)

    def manifests(self) -> list[Path]:
        """Return the manifests of all writers."""
        return sorted(self.folder.glob("manifest*.jsonl"))

    def _check(self, card: dict[str, Any]) -> None:
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
                f"({'; '.join(found)}); choose another "
                "data.folder or restore the scene"
            )
        if card["seed"] != self.seed:
            raise DataSetError(
                f"{self.folder} was drawn with seed {card['seed']}, not {self.seed}; "
                "choose another data.folder or data.seed"
            )

    def missing(self, split: str, count: int, shard: int = 0, shards: int = 1) -> list[int]:
        """Return which of the first `count` loads of a split have not been tried.

        Args:
            split: train, val or test.
            count: So many loads are wanted.
            shard: Of these the ones that fall to this writer, of
            shards: so many, who take files in turn.
        """
        tried: set[int] = set()
        for line in self.shards():
            if line["split"] == split:
                tried.update(range(line["first"], line["first"] + line["tried"]))
        mine = (index for index in range(count) if index // SHARD % shards == shard)
        return [index for index in mine if index not in tried]

    def tried(self) -> set[LoadKey]:
        """Return the loads that are in a shard, or rejected there."""
        return {
            LoadKey(self.stream(line["split"]), index)
            for line in self.shards()
            for index in range(line["first"], line["first"] + line["tried"])
        }

    def load(self, split: str, count: int) -> Sample:
        """Return the accepted ones of the first `count` loads of a split, in order.

        Raises:
            DataSetError: A shard is damaged, or there are no samples.
        """
        parts = []
        for line in self.shards():
            if line["split"] == split and line["first"] < count:
                parts.append(self._read(line))
        index = torch.cat([part["index"] for part in parts]) if parts else torch.zeros(0)
        keep = np.unique(index.numpy(), return_index=True)[1]  # two writers may have had one load
        keep = keep[index.numpy()[keep] < count]
        if not len(keep):
            raise DataSetError(f"{self.folder} holds no {split} samples")
        force, displacement, point, poisson = (
            torch.cat([part[name] for part in parts])[keep]
            for name in ("force", "displacement", "point", "poisson")
        )
        return Sample(force, displacement, self.scene.loads.young_at(point), poisson)

    def _read(self, line: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return what a shard holds, forces as fields (B, N, D).

        Raises:
            DataSetError: It is damaged.
        """
        try:
            return self.sound(line)
        except ValueError as error:
            raise DataSetError(
                f"{self.folder / line['file']} {error}; scripts/generate.py action=repair with the "
                "same scene solves its loads again"
            ) from None

    def sound(self, line: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return what a shard holds.

        Raises:
            ValueError: It is damaged; the message goes on after its name.
        """
        path = self.folder / line["file"]
        if path.parent != self.folder:
            raise ValueError("is not in the folder of the data set and is not read")
        if path.is_symlink() or not path.is_file():
            raise ValueError("is missing")
        if path.stat().st_size > self.largest(line["tried"]):
            raise ValueError("is damaged: it is larger than its loads")
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != line["sha256"]:
            raise ValueError("is damaged: its SHA-256 is not the manifest's")
        shard = self.opened(content)
        if shard["index"].tolist() != kept_in(line):
            raise ValueError("holds other loads than the manifest says")
        return shard

    def largest(self, loads: int) -> int:
        """Return the number of bytes that a shard of so many loads has at most."""
        numbers = 3 * math.prod(self.scene.problem.shape) + self.scene.loads.n_random + 8
        return HEADER + 8 * numbers * loads

    def opened(self, content: bytes) -> dict[str, Tensor]:
        """Return the columns of a shard of this scene, see `decode_shard`."""
        loads = self.scene.loads
        own = int(loads.poisson_range is not None)
        return decode_shard(content, self.scene.problem.shape, loads.n_random, own)

    def reader(self, split: str) -> Callable[[int], SolvedLoad | None]:
        """Return what gives a split's loads one at a time, None for those not there at present."""
        lines = {
            index: line
            for line in self.shards()
            if line["split"] == split
            for index in range(line["first"], line["first"] + line["tried"])
        }
        spooled = self.pending.files()
        shard: dict[str, Tensor] = {}
        held: dict[str, Any] | None = None

        def read(index: int) -> SolvedLoad | None:
            nonlocal shard, held
            if (line := lines.get(index)) is None:
                path = spooled.get(LoadKey(self.stream(split), index))
                with suppress(FileNotFoundError):  # it is in a shard by now
                    return self.pending.get(path) if path else None
                return None
            if held is not line:
                shard, held = self._read(line), line
            return select(shard, LoadKey(self.stream(split), index), line)

        return read

    def digest(self, split: str, count: int) -> str:
        """Return the SHA-256 of a split's samples in order, however they came into their shards."""
        found = hashlib.sha256()
        for column in self.load(split, count)[:2]:
            found.update(column.contiguous().numpy().tobytes())
        return found.hexdigest()

    def modes(self) -> dict[str, Tensor]:
        """Return the stored arrays of the load family, such as modes, see `LoadFamily.arrays`.

        Raises:
            DataSetError: They are damaged.
        """
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

    def acceptance(self) -> list[balance.AmplitudeBin]:
        """Return how many loads of each amplitude were accepted, all splits together."""
        amplitudes: list[float] = []
        accepted: list[bool] = []
        for line in self.shards():
            rejected = {one["index"] for one in line["rejected"]}
            amplitudes += line["amplitudes"]
            accepted += [line["first"] + k not in rejected for k in range(line["tried"])]
        return balance.amplitude_bins(amplitudes, accepted)

    def summary(self) -> str:
        """Return how many loads were tried and accepted, by split and by amplitude."""
        lines = [str(self.folder)]
        for split in STREAMS:
            shards = [line for line in self.shards() if line["split"] == split]
            tried, accepted = (sum(line[key] for line in shards) for key in ("tried", "accepted"))
            if tried:
                mean = sum(line["iterations"] for line in shards) / tried
                lines.append(
                    f"  {split}: {accepted} of {tried} loads accepted, {mean:.1f} Newton iterations"
                )
        lines += [f"  {row}" for row in balance.acceptance_table(self.acceptance())]
        sessions = self._sessions()
        if loads := sum(one["loads"] for one in sessions):
            core = sum(one["core_seconds"] for one in sessions) / loads
            wall = sum(one["seconds"] for one in sessions)
            size = sum(path.lstat().st_size for path in self.folder.glob("*.safetensors")) / 1e6
            lines.append(
                f"  {core:.3f} s a load on one core, {wall:.0f} s of wall time in {len(sessions)} "
                f"sessions, {size:.0f} MB"
            )
        return "\n".join(lines)

    def _sessions(self) -> list[dict[str, Any]]:
        """Return the lines of the journal that say how long."""
        return [
            line
            for line in read_jsonl(self.folder / "journal.jsonl")
            if all(is_number(line.get(key)) for key in ("loads", "seconds", "core_seconds"))
        ]

    def seconds_a_load(self) -> float | None:
        """Return the wall time of a load in all sessions so far [s]; None before the first."""
        sessions = self._sessions()
        loads = sum(one["loads"] for one in sessions)
        return sum(one["seconds"] for one in sessions) / loads if loads else None


def runs(indices: Sequence[int], *, whole: bool = False) -> Iterator[list[int]]:
    """Yield runs of consecutive indices, none across a multiple of SHARD: a file each.

    Args:
        indices: Ascending.
        whole: Those of SHARD indices alone.
    """
    run: list[int] = []
    for index in [*indices, None]:
        if run and (index is None or index != run[-1] + 1 or index % SHARD == 0):
            if not whole or len(run) == SHARD:
                yield run
            run = []
        if index is not None:
            run.append(index)

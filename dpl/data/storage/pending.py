"""Solved loads whose shard is not complete yet, each in a file of its own."""

import hashlib
import json
import re
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save
from torch import Tensor

from dpl.data.solving.solve import LoadKey, SolvedLoad
from dpl.data.storage.manifest import entry_of_load
from dpl.data.storage.shard import Columns, encode_load
from dpl.system.files import atomic_write, read_regular_file

NAME = re.compile(r"([a-z]+)-(\d{6,18})\.load")
DIGEST_SIZE = 32  # bytes
PARTIAL_FILE_AGE = 10.0  # age above which the writer of an unfinished file is taken for dead [s]


@dataclass(frozen=True)
class PendingLoads:
    """A folder of solved loads.

    A file holds the SHA-256 of its name and of the rest, the manifest entry of the load (a line of
    JSON), and a shard of this load alone.

    Attributes:
        folder: The folder; created by the first `write`.
        streams: Seed of each split.
        parameters_at: From points (B, d) to parameters (B, P).
    """

    folder: Path
    streams: dict[str, tuple[int, int]]
    parameters_at: Callable[[Tensor], Tensor]

    def write(self, solved: SolvedLoad) -> Path:
        """Write a load; return the path of its file."""
        self.folder.mkdir(exist_ok=True)
        (split,) = (name for name, seed in self.streams.items() if seed == solved.job.seed)
        path = self.folder / f"{split}-{solved.job.number:06d}.load"
        columns = encode_load(solved, self.parameters_at(torch.from_numpy(solved.point)[None]))
        content = json.dumps(entry_of_load(split, solved)).encode() + b"\n" + save(columns)
        # not synced: `files` removes a file that a crash of the machine has damaged
        with atomic_write(path, sync=False) as file:
            file.write(_digest(path, content) + content)
        return path

    def read(self, path: Path) -> tuple[dict[str, Any], Columns]:
        """Return manifest entry and columns of a load that `files` has found."""
        # the content may come from another machine, and both are part of the path of a shard
        split, number = path.stem.split("-")
        entry, _, columns = path.read_bytes()[DIGEST_SIZE:].partition(b"\n")
        return {**json.loads(entry), "split": split, "first": int(number)}, load(columns)

    def files(self) -> dict[LoadKey, Path]:
        """Return the files by load; remove damaged ones.

        Raises:
            DataSetError: One is not a regular file.
        """
        found = {}
        for path in sorted(self.folder.glob("*.load")):
            name = NAME.fullmatch(path.name)
            # a symbolic link is not followed: its load is solved again
            if not name or name[1] not in self.streams or path.is_symlink():
                continue
            with suppress(FileNotFoundError):  # another writer has moved it into a shard
                content = read_regular_file(path)
                if _digest(path, content[DIGEST_SIZE:]) == content[:DIGEST_SIZE]:
                    found[LoadKey(self.streams[name[1]], int(name[2]))] = path
                else:
                    path.unlink()
        return found


def _digest(path: Path, content: bytes) -> bytes:
    return hashlib.sha256(path.name.encode() + content).digest()


def clean_partial_files(folder: Path) -> None:
    """Remove files that killed processes left unfinished in a folder or below it."""
    for path in folder.rglob(".*.part"):
        with suppress(FileNotFoundError):
            if time.time() - path.stat().st_mtime > PARTIAL_FILE_AGE:
                path.unlink()

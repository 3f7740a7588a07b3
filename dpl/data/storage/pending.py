"""Loads that are solved and wait for their shard: a file each, whole or not there."""

import hashlib
import re
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from dpl.data.solving.solve import LoadKey, SolvedLoad
from dpl.data.storage.shard import deserialize, serialize
from dpl.system.files import atomic_write, read_regular_file

NAME = re.compile(r"([a-z]+)-(\d{6,18})\.load")
DIGEST = 32  # bytes of SHA-256, of its name and itself, before a load
LEFT = 10.0  # age from which on a file that was not finished is a killed process's [s]


@dataclass(frozen=True)
class PendingSamples:
    """A folder of loads, each in a file of its own.

    Attributes:
        folder: Where they are; made and removed as needed.
        streams: Seed of each split.
    """

    folder: Path
    streams: dict[str, tuple[int, int]]

    def put(self, one: SolvedLoad) -> Path:
        """Write a load; return its file."""
        self.folder.mkdir(exist_ok=True)
        (split,) = (name for name, seed in self.streams.items() if seed == one.job.seed)
        path = self.folder / f"{split}-{one.job.number:06d}.load"
        content = serialize(one)
        # not synced: what a crash of the machine damages, its digest tells
        with atomic_write(path, sync=False) as file:
            file.write(_digest(path, content) + content)
        return path

    def get(self, path: Path) -> SolvedLoad:
        """Return the load in a file."""
        return deserialize(path.read_bytes()[DIGEST:])

    def files(self) -> dict[LoadKey, Path]:
        """Return the loads that are there; damaged ones are removed.

        Raises:
            DataSetError: One is no file of its own.
        """
        found = {}
        for path in sorted(self.folder.glob("*.load")):
            if not (name := NAME.fullmatch(path.name)) or name[1] not in self.streams:
                continue
            if path.is_symlink():  # not followed: its load is solved again
                continue
            with suppress(FileNotFoundError):  # another writer has made a shard of it meanwhile
                content = read_regular_file(path)
                if _digest(path, content[DIGEST:]) == content[:DIGEST]:
                    found[LoadKey(self.streams[name[1]], int(name[2]))] = path
                else:
                    path.unlink()
        return found

    def clean(self) -> None:
        """Remove the folder if nothing is in it."""
        with suppress(OSError):
            self.folder.rmdir()


def _digest(path: Path, content: bytes) -> bytes:
    """Return what tells that a file is whole, and the load that its name says."""
    return hashlib.sha256(path.name.encode() + content).digest()


def clean_partial_files(folder: Path) -> None:
    """Remove what killed processes were writing in a folder or below it."""
    for path in folder.rglob(".*.part"):
        with suppress(FileNotFoundError):
            if time.time() - path.stat().st_mtime > LEFT:
                path.unlink()

"""Loads that are solved and wait for their shard: a file each, whole or not there."""

import hashlib
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from dpl.data.durable import whole_file
from dpl.data.outcome import Job, Outcome
from dpl.data.shard import packed, unpacked

DIGEST = 32  # bytes of SHA-256 before a load
LEFT = 10.0  # age from which on a file that was not finished is a killed process's [s]


@dataclass(frozen=True)
class Spool:
    """A folder of loads, each in a file of its own.

    Attributes:
        folder: Where they are; made and removed as needed.
        streams: Seed of each split.
    """

    folder: Path
    streams: dict[str, tuple[int, int]]

    def put(self, one: Outcome) -> Path:
        """Write a load; return its file."""
        self.folder.mkdir(exist_ok=True)
        (split,) = (name for name, seed in self.streams.items() if seed == one.job.seed)
        path = self.folder / f"{split}-{one.job.number:06d}.load"
        content = packed(one)
        # not synced: what a crash of the machine damages, its digest tells
        with whole_file(path, sync=False) as file:
            file.write(hashlib.sha256(content).digest() + content)
        return path

    def get(self, path: Path) -> Outcome:
        """Return the load in a file."""
        return unpacked(path.read_bytes()[DIGEST:])

    def files(self) -> dict[Job, Path]:
        """Return the loads that are there; damaged ones are removed."""
        found = {}
        for path in sorted(self.folder.glob("*-*.load")):
            split, number = path.stem.split("-")
            with suppress(FileNotFoundError):  # another writer has made a shard of it meanwhile
                content = path.read_bytes()
                if hashlib.sha256(content[DIGEST:]).digest() == content[:DIGEST]:
                    found[Job(self.streams[split], int(number))] = path
                else:
                    path.unlink()
        return found

    def tidy(self) -> None:
        """Remove the folder if nothing is in it."""
        with suppress(OSError):
            self.folder.rmdir()


def sweep(folder: Path) -> None:
    """Remove what killed processes were writing in a folder or below it."""
    for path in folder.rglob(".*.part"):
        with suppress(FileNotFoundError):
            if time.time() - path.stat().st_mtime > LEFT:
                path.unlink()

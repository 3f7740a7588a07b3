"""Files that are whole or not there, and folders that one process at a time writes to."""

import fcntl
import json
import os
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

TEXT = 2.0**28  # bytes of one in a data set, at most


class DataSetError(ValueError):
    """A data set that cannot be used, and what to do about it, in one line."""

    def __init__(self, told: str) -> None:
        """Fold what is told into a line."""
        super().__init__(" ".join(told.splitlines()))


@contextmanager
def atomic_write(path: Path, *, sync: bool = True) -> Iterator[BinaryIO]:
    """Open a file to write that will be there whole or not at all.

    Args:
        path: Where it will be.
        sync: Whether it must survive a crash of the machine too, and not of this process only.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            yield file
            file.flush()
            if sync:
                os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    if sync:
        sync_folder(path.parent)


def write_file(path: Path, content: bytes) -> None:
    """Write a file of a data set, whole or not at all.

    Raises:
        DataSetError: A folder is in its place.
    """
    try:
        with atomic_write(path) as file:
            file.write(content)
    except IsADirectoryError:
        raise DataSetError(
            f"{path} is a folder where a file must be; remove it or choose another data.folder"
        ) from None


def sync_folder(path: Path) -> None:
    """Make what was renamed or removed in a folder survive a crash of the machine."""
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def append_jsonl(path: Path, line: dict[str, Any]) -> None:
    """Add a line of JSON, synced; after a line that a crash has torn, on a line of its own.

    Raises:
        DataSetError: The file is a link, a folder or a device, or far too large.
    """
    with suppress(FileNotFoundError):
        _refuse_foreign(path, TEXT)
    with path.open("ab+", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - 1))
        torn = size > 0 and file.read(1) != b"\n"
        left = b"\n" * torn + json.dumps(line).encode() + b"\n"
        try:
            while left:
                left = left[file.write(left) :]
            os.fsync(file.fileno())
        except OSError:  # no space: the half of a line is taken back
            os.ftruncate(file.fileno(), size)
            raise


def read_regular_file(path: Path, most: float = TEXT) -> bytes:
    """Return the content of a file of a data set.

    Raises:
        FileNotFoundError: There is none.
        DataSetError: It is a link, a folder or a device, or larger than `most` bytes.
    """
    _refuse_foreign(path, most)
    return path.read_bytes()


def _refuse_foreign(path: Path, most: float) -> None:
    status = path.lstat()
    if not stat.S_ISREG(status.st_mode):
        raise DataSetError(
            f"{path} is no file of its own, and links are not followed; put the file itself there, "
            "remove it, or choose another data.folder"
        )
    if status.st_size > most:
        raise DataSetError(
            f"{path} is damaged: it has {status.st_size:,} bytes, and at most {most:,.0f} are "
            "expected; remove it or choose another data.folder"
        )


def read_jsonl(path: Path) -> list[dict[str, Any]]:
    """Return the lines of JSON in a file, those left out that a crash has torn.

    Raises:
        DataSetError: It is no file of its own, see `read_regular_file`.
    """
    return [line for line in parsed_lines(path) if line is not None]


def parsed_lines(path: Path) -> list[dict[str, Any] | None]:
    """Return what each line of a file holds, None for a line that is not a JSON object.

    Raises:
        DataSetError: It is no file of its own, see `read_regular_file`.
    """
    content = b""
    with suppress(FileNotFoundError):
        content = read_regular_file(path)
    return [_parsed(line) for line in content.splitlines()]


def _parsed(line: bytes) -> dict[str, Any] | None:
    with suppress(ValueError, RecursionError):
        found = json.loads(line)
        return found if isinstance(found, dict) else None
    return None


@contextmanager
def exclusive_lock(folder: Path, shard: int = 0, shards: int = 1) -> Iterator[None]:
    """Be the only writer of shard `shard` of `shards` of a folder; a dead writer does not count.

    The kernel keeps the locks (flock), so none outlives its process.

    Raises:
        DataSetError: Another process writes some of the same; its number and machine are named.
    """
    with ExitStack() as held:
        with (folder / ".writers").open("a") as gate:
            fcntl.flock(gate, fcntl.LOCK_EX)
            for other in folder.glob(".writer-*"):
                _, k, n = other.name.split("-")
                if (int(n) == shards and int(k) != shard) or not (holder := _holder(other)):
                    continue
                raise DataSetError(
                    f"{folder} is being written by {holder}; wait for it, stop it, or choose "
                    "another data.folder"
                )
            mine = folder / f".writer-{shard}-{shards}"
            file = held.enter_context(mine.open("w"))
            fcntl.flock(file, fcntl.LOCK_EX)
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            file.write(f"process {os.getpid()} on {socket.gethostname()} since {since}")
            file.flush()
            held.callback(mine.unlink, missing_ok=True)
        yield


def _holder(path: Path) -> str:
    """Return who holds a lock; empty if nobody does."""
    try:
        with path.open("r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return ""
    except BlockingIOError:
        with suppress(FileNotFoundError):  # it has just ended
            return path.read_text() or "another process"
    return ""

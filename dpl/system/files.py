"""Atomic writes, reading of regular files, arrays, JSON lines, and exclusive locks of folders."""

import fcntl
import json
import math
import os
import socket
import stat
import time
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

# checkpoints from which a run is loaded, by priority; a short run has only its last one
LOADABLE = ("best.safetensors", "best.ckpt", "last.ckpt")
MAX_ARRAY_SIZE = 2**30  # of an array in a file, and of its float64 numbers [bytes]
MAX_TEXT_SIZE = 2.0**28  # of a text file in a data set [bytes]


class DataSetError(ValueError):
    """Unusable data set; the message is one line that names the remedy."""

    def __init__(self, message: str) -> None:
        """Join the lines of the message."""
        super().__init__(" ".join(message.splitlines()))


@contextmanager
def atomic_write(path: Path, *, sync: bool = True) -> Iterator[BinaryIO]:
    """Open a temporary file for writing; it replaces `path` when the context ends without error.

    With `sync`, the file survives a crash of the machine, not only of this process.
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


def write_file(path: Path, content: bytes, *, sync: bool = True) -> None:
    """Write a file of a data set atomically, see `atomic_write`."""
    with atomic_write(path, sync=sync) as file:
        file.write(content)


def sync_folder(path: Path) -> None:
    """Make renamed and removed files of a folder survive a crash of the machine."""
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def append_jsonl(path: Path, line: dict[str, Any]) -> None:
    """Append a line of JSON to a regular file and sync it; terminate an incomplete line first."""
    with suppress(FileNotFoundError):
        _check_regular_file(path, MAX_TEXT_SIZE)
    with path.open("ab+") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - 1))
        incomplete = size > 0 and file.read(1) != b"\n"
        file.write(b"\n" * incomplete + json.dumps(line).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def read_regular_file(path: Path, most: float = MAX_TEXT_SIZE) -> bytes:
    """Return the content of a file of a data set, no link, folder or device, of `most` bytes."""
    _check_regular_file(path, most)
    return path.read_bytes()


def _check_regular_file(path: Path, most: float) -> None:
    status = path.lstat()
    if not stat.S_ISREG(status.st_mode):
        raise DataSetError(
            f"{path} is not a regular file (symbolic links are refused); replace it by the file "
            "itself, remove it, or choose another data.folder"
        )
    if status.st_size > most:
        raise DataSetError(
            f"{path} is damaged: its size is {status.st_size:,} bytes, and at most {most:,.0f} are "
            "expected; remove it or choose another data.folder"
        )


def read_array(path: Path, row: tuple[int, ...], name: str | None = None) -> NDArray[np.float64]:
    """Return the array in a .npy file, or one in a .npz file, (S, *row) with S > 0.

    The kind and the size of the file, and type and shape in the header of the array, are checked
    before the array is read. A -1 in `row` stands for any number. `name` is that of the array in a
    .npz file with several.
    """
    if path.suffix not in (".npy", ".npz"):
        raise ValueError("the file must be .npy or .npz")
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("the file is a directory, a pipe or a device and must be a regular file")
    if status.st_size > MAX_ARRAY_SIZE:
        raise ValueError(f"the file must have at most {MAX_ARRAY_SIZE:,} bytes")
    try:
        if path.suffix == ".npy":
            with path.open("rb") as file:
                return _read_npy(file, status.st_size, row)
        with zipfile.ZipFile(path) as archive:
            every = archive.infolist()
            members = [one for one in every if len(every) == 1 or one.filename == f"{name}.npy"]
            if len(members) != 1:
                which = "one array" if name is None else f"an array {name!r}"
                names = ", ".join(array_names(path)) or "none"
                raise ValueError(f"the file must contain {which} and has {len(every)}: {names}")
            if members[0].compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError("the file must be written by numpy.savez")
            with archive.open(members[0]) as member:
                return _read_npy(member, members[0].file_size, row)
    except (OSError, ValueError):
        raise
    except Exception as error:  # of zipfile, zlib, or the parser of the header
        raise ValueError(f"the file is damaged: {' '.join(str(error).split())}") from error


def array_names(path: Path) -> list[str]:
    """Return the names of the arrays in a .npz file; none if it is no archive."""
    with suppress(zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]
    return []


def _read_npy(file: IO[bytes], size: int, row: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the array (S, *row) of a .npy file of so many bytes."""
    headers = np.lib.format.read_array_header_1_0, np.lib.format.read_array_header_2_0
    shape, fortran, dtype = headers[np.lib.format.read_magic(file)[0] == 2](file)
    count, body = math.prod(shape), size - file.tell()
    fits = len(shape) == 1 + len(row) and all(
        n in (-1, given) for n, given in zip(row, shape[1:], strict=True)
    )
    if dtype.kind not in "fiu" or not fits or not count > 0:
        wanted = ", ".join("any" if n == -1 else str(n) for n in row)
        raise ValueError(f"the array of {dtype} of shape {shape} must be numbers (S, {wanted})")
    if count * dtype.itemsize != body:
        raise ValueError(f"the file is damaged: {body:,} bytes for an array of shape {shape}")
    if 8 * count > MAX_ARRAY_SIZE:
        raise ValueError(f"the array must have at most {MAX_ARRAY_SIZE // 8:,} numbers")
    array = np.frombuffer(file.read(body), dtype, count)
    return array.reshape(shape, order="F" if fortran else "C").astype(np.float64)


def read_jsonl(path: Path) -> list[dict[str, Any]]:
    """Return the JSON objects in the lines of a regular file, without other lines.

    A file that does not exist has no lines.
    """
    found = []
    with suppress(FileNotFoundError):
        for line in read_regular_file(path).splitlines():
            with suppress(ValueError, RecursionError):
                found.append(json.loads(line))
    return [value for value in found if isinstance(value, dict)]


@contextmanager
def exclusive_lock(folder: Path, shard: int = 0, shards: int = 1) -> Iterator[None]:
    """Hold the lock of writer `shard` of `shards` writers of a folder.

    Writers of the same number `shards` and different `shard` do not exclude each other. The kernel
    keeps the locks (flock), so that none outlives its process. A `DataSetError` names the process
    that holds a lock which excludes this one.
    """
    with ExitStack() as stack:
        with (folder / ".writers").open("a") as gate:
            fcntl.flock(gate, fcntl.LOCK_EX)
            for other in folder.glob(".writer-*"):
                k, n = map(int, other.name.split("-")[1:])
                if (n != shards or k == shard) and (holder := _holder(other)):
                    raise DataSetError(
                        f"{folder} is being written by {holder}; wait for it, stop it, or choose "
                        "another data.folder"
                    )
            mine = folder / f".writer-{shard}-{shards}"
            file = stack.enter_context(mine.open("w"))
            fcntl.flock(file, fcntl.LOCK_EX)
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            file.write(f"process {os.getpid()} on {socket.gethostname()} since {since}")
            file.flush()
            stack.callback(mine.unlink, missing_ok=True)
        yield


def _holder(path: Path) -> str:
    """Return a description of the process that holds a lock; empty if none does."""
    with suppress(FileNotFoundError):  # the process has just ended
        try:
            with path.open("r+") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return path.read_text() or "another process"
    return ""

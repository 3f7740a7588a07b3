"""Mesh files from anywhere: what is refused unread, and meshio under limits of memory and time.

Refused are files that are no plain file, too large, packed, or that send the reader to other files
or the network; XML that declares entities or is nested deeply; and counts of nodes or cells that no
file of the size can hold. The rest is read by `dpl.fem.mesh.sandbox_worker` in a process of its
own, which may take memory and time by the size of the file: what no rule foresees (a compressed
bomb, a number of nodes of 2 * 10^9, a reader that loops) ends there.
"""

import atexit
import contextlib
import json
import math
import os
import pickle
import re
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from dpl.fem.mesh.sandbox_checks import HDF5, MOST_BYTES, vet_count, vet_hdf5, vet_xml

MEMORY = (2**30, 100)  # that reading may take [B]: at any rate, and per byte of the file
SECONDS = (10.0, 2e-6)  # that reading may last [s]: at any rate, and per byte of the file
PACKED = {b"\x1f\x8b": "gzip", b"PK\x03\x04": "zip", b"BZh": "bzip2", b"\xfd7zXZ": "xz"}
XML = (".vtu", ".xdmf", ".xmf", ".xml")


def read(path: Path) -> meshio.Mesh:
    """Return what meshio reads from a file that is not to be trusted.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is refused, or cannot be read; in one line that names it.
    """
    try:
        size = _vet(path)
    except ValueError as error:
        raise ValueError(f"{path}: refused: {error}") from None
    raw, said = READER.ask(path, MEMORY[0] + MEMORY[1] * size, SECONDS[0] + SECONDS[1] * size)
    if raw is None:
        raise ValueError(f"{path}: cannot be read as a mesh: {_reason(said)}")
    if np.ndim(raw.points) != 2:
        raise ValueError(f"{path}: cannot be read as a mesh: it lists no nodes, or ends too early")
    for what, promised, found in _promises(path, raw):
        raise ValueError(
            f"{path}: cannot be read as a mesh: it declares {promised} {what} and holds {found}"
        )
    return raw


def _reason(said: dict[str, Any]) -> str:
    if said.get("memory"):
        return "it takes more memory than a file of its size should; write it anew"
    if "died" in said:
        late = hasattr(signal, "SIGALRM") and said["died"] == -signal.SIGALRM
        what = "takes longer than a file of its size should" if late else "breaks the reader"
        return f"it {what} (status {said['died']}); write it anew"
    text = said["text"]
    if "'gmsh:physical'" in text:
        return "only some of its cells are in physical groups; give each part one"
    if said["known"] and text:
        return text
    return f"it is damaged or ends too early{f' ({text})' if text else ''}"


class _Reader:
    """The process that reads, started when it is first needed, and again when it has died."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()

    def ask(
        self, path: Path, memory: int, seconds: float
    ) -> tuple[meshio.Mesh | None, dict[str, Any]]:
        """Return the mesh of a file, or None and what there is to say about it."""
        request = {"path": str(path.absolute()), "memory": memory, "seconds": seconds}
        with self._lock:
            process = self._running()
            assert process.stdin
            assert process.stdout
            try:
                process.stdin.write(json.dumps(request).encode() + b"\n")
                process.stdin.flush()
                answer = pickle.load(process.stdout)  # by our own program
            except (EOFError, pickle.UnpicklingError, OSError):
                self.end()
                return None, {"died": process.returncode}
            except BaseException:  # an answer that nobody waits for would be taken for the next one
                self.end()
                raise
            if answer[0] is None and answer[1].get("memory"):
                self.end()
            return answer

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._process.poll() is not None:
            program = Path(__file__).with_name("sandbox_worker.py")
            self._process = subprocess.Popen(
                [sys.executable, "-P", str(program)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                env=os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
                start_new_session=True,
            )  # fmt: skip
        return self._process

    def end(self) -> None:
        """End the process; the next question starts another."""
        if self._process:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout):
                with contextlib.suppress(OSError):
                    pipe.close()  # type: ignore[union-attr]
        self._process = None

    def forget(self) -> None:
        """Leave the process to the one that this one was forked from."""
        self._process, self._lock = None, threading.Lock()


READER = _Reader()
atexit.register(READER.end)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=READER.forget)


def _vet(path: Path) -> int:
    """Return the size of a file that may be read [B].

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is refused.
    """
    try:
        found = path.stat()
    except (OSError, ValueError):
        raise FileNotFoundError(f"{path}: no such mesh file") from None
    if stat.S_ISDIR(found.st_mode):
        raise FileNotFoundError(f"{path}: is a folder, no mesh file")
    if not stat.S_ISREG(found.st_mode):
        raise ValueError("it is a device or a pipe; copy what it gives into a file")
    if found.st_size > MOST_BYTES:
        raise ValueError(
            f"it has {found.st_size / 2**30:.1f} GiB, at most {MOST_BYTES / 2**30:.0f} are read"
        )
    with path.open("rb") as file:
        head = file.read(512)
    for magic, name in PACKED.items():
        if head.startswith(magic):
            raise ValueError(f"it is packed ({name}); unpack it")
    suffix = path.suffix.lower()
    if head.startswith(HDF5):
        vet_hdf5(path)
    if suffix in XML:
        vet_xml(path)
    if suffix == ".xml":
        for other in path.resolve().parent.glob("*.xml"):  # cell data, which meshio looks for
            if other.name.startswith(f"{path.stem}_"):
                if not other.is_file():
                    raise ValueError(f"{other.name} beside it is no file; remove it")
                vet_xml(other)
    if suffix in (".node", ".ele"):
        for other in (path.with_suffix(".node"), path.with_suffix(".ele")):
            if not other.is_file():
                raise ValueError(f"it needs {other.name} beside it")
    if suffix == ".inp":
        _vet_inp(path)
    for what, count in _declared(path).items():
        vet_count(what, count, found.st_size)
    return found.st_size


def _declared(path: Path) -> dict[str, int]:
    """Return how many nodes and cells a file of some formats says that it lists."""
    suffix = path.suffix.lower()
    if suffix not in (".msh", ".vtk", ".su2"):
        return {}
    data = path.read_bytes()
    if suffix == ".vtk":
        found = {"nodes": rb"^POINTS\s+(-?\d+)", "cells": rb"^CELL_TYPES\s+(-?\d+)"}
        counts = {w: _sum(re.findall(p, data, re.M | re.I)[:1]) for w, p in found.items()}
        grid = re.search(rb"^DIMENSIONS\s+(\d+)\s+(\d+)\s+(\d+)", data, re.M | re.I)
        return {"nodes of a grid": math.prod(map(_number, grid.groups()))} if grid else counts
    if suffix == ".su2":
        found = {
            "nodes": rb"^\s*NPOIN=\s*(-?\d+)",
            "cells": rb"^\s*(?:NELEM|MARKER_ELEMS)=\s*(-?\d+)",
        }
        return {what: _sum(re.findall(pattern, data, re.M)) for what, pattern in found.items()}
    version = re.search(rb"\$MeshFormat\s+(\d(?:\.\d)?)\s+([01])\s+(\d)\s", data)
    if not version:  # of Ansys
        return {}
    counts = {}
    for what, block in (("nodes", rb"\$Nodes"), ("cells", rb"\$Elements")):
        head = re.search(rb"^" + block + rb"[ \t\r]*\n", data, re.M)
        rest = data[head.end() : head.end() + 100] if head else b""
        if version[1] >= b"3" and version[2] == b"1":  # blocks, then what counts
            size = 8 if version[1] == b"4.0" else int(version[3])
            counts[what] = int.from_bytes(rest[size : 2 * size], sys.byteorder)
        else:
            numbers = re.findall(rb"-?\d+", rest.lstrip().partition(b"\n")[0])
            counts[what] = _sum(numbers[version[1] >= b"3" :][:1])
    return counts


def _promises(path: Path, raw: meshio.Mesh) -> Iterator[tuple[str, int, int]]:
    """Yield what a file declares and does not hold: what, how many, how many it holds."""
    held = {"nodes": len(raw.points), "cells": sum(len(block.data) for block in raw.cells)}
    for what, count in _declared(path).items():
        if count != held.get(what, count):
            yield what, count, held[what]


def _sum(numbers: list[bytes]) -> int:
    return sum(map(_number, numbers))


def _number(digits: bytes) -> int:
    return int(digits[:20])  # of more, one is as bad as another


def _vet_inp(path: Path) -> None:
    with path.open(errors="replace") as file:
        for line in file:
            keyword = line.partition(",")[0].strip().replace("*", "").upper()
            if keyword == "INCLUDE" and not line.startswith("**"):
                raise ValueError("it includes another file (*INCLUDE); join them in one")

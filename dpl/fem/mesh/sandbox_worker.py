"""A program that reads mesh files by meshio for `dpl.fem.mesh.sandbox`, in a process of its own.

It takes requests as lines of JSON and answers each with a pickled pair: the mesh or None, and what
to say about it. Here meshio is held to what files declare; in the process that asked it stays as
it is.
"""

import builtins
import contextlib
import importlib
import io
import json
import lzma
import os
import pickle
import signal
import sys
import types
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import meshio
import numpy as np

UNPACKED = (2**26, 100)  # that packed data may hold [B]: at any rate, and per byte of the file
MOST_ENDS = 1000  # times that a reader may ask for more after the end


def main() -> None:
    """Answer requests until there are no more, on what was the standard output."""
    answers = os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    stricter()
    if sys.platform == "linux":
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))  # no reader has anything to write
    for line in sys.stdin:
        request = json.loads(line)
        os.chdir(Path(request["path"]).parent)  # XDMF names files from its own folder
        with limits(request["memory"], request["seconds"]):
            answer = read(request["path"])
        pickle.dump(answer, answers, protocol=5)
        answers.flush()
        if answer[1].get("memory"):
            return


@contextlib.contextmanager
def limits(memory: int, seconds: float) -> Iterator[None]:
    """Bound the memory [B] that is added and, on penalty of death, the time [s]."""
    resource: Any = None
    if sys.platform == "linux":
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        most = used + memory if hard == resource.RLIM_INFINITY else min(used + memory, hard)
        resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, seconds)
    yield
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0)
    if resource:
        resource.setrlimit(resource.RLIMIT_AS, (hard, hard))


def read(path: str) -> tuple[meshio.Mesh | None, dict[str, Any]]:
    """Return what meshio reads, or None and what it says: its text, and of which kind it is."""
    said = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(said),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", ".*could not be read to its end")
            _Unpacker.left = UNPACKED[0] + UNPACKED[1] * os.path.getsize(path)
            mesh = meshio.read(path)
            _once(getattr(mesh, "points_id", ()))  # of Nastran
            return mesh, {}
    except MemoryError:
        return None, {"memory": True}
    except (Exception, SystemExit) as error:  # meshio calls sys.exit on files it cannot read
        known = isinstance(error, (SystemExit, meshio.ReadError, ImportError))
        text = said.getvalue().split("Error:")[0] if isinstance(error, SystemExit) else str(error)
        text = "".join(c if c.isprintable() else " " for c in text)
        return None, {"text": " ".join(text.split())[:500], "known": known}


def stricter() -> None:
    """Make meshio's readers of the commonest formats hold files to what they declare."""
    gmsh: list[Any] = [importlib.import_module(f"meshio.gmsh._gmsh{v}") for v in (22, 40, 41)]
    common, main_ = [importlib.import_module(f"meshio.gmsh.{n}") for n in ("common", "main")]
    modules: list[Any] = [
        importlib.import_module(f"meshio.{name}")
        for name in ("vtu._vtu", "vtk._vtk_51", "_vtk_common", "dolfin._dolfin")
    ]
    vtu, vtk, shared, dolfin = modules
    builtins.open = _open  # type: ignore[assignment]
    for module in (*gmsh, common, main_):
        module._fast_forward_to_end_block = _end_block
    for module in (*gmsh[1:], dolfin):
        # else rows that a file declares and does not list are what was in memory before
        module.np = types.SimpleNamespace(**{**vars(np), "empty": _nothing})
    for module in gmsh[1:]:
        module._read_nodes = _listed(module._read_nodes)
    for module, first in zip(gmsh, (0, 0, 1), strict=True):  # 4.1 has them counted from 0
        module._read_nodes = _numbered_once(module._read_nodes, first)
    for name in ("abaqus._abaqus", "permas._permas", "avsucd._avsucd"):
        other: Any = importlib.import_module(f"meshio.{name}")
        other._read_nodes = _numbered_once(other._read_nodes)
    gmsh[0]._gmsh_to_meshio_order = _counted_from_one(common._gmsh_to_meshio_order)
    gmsh[0]._read_cells_ascii = _of_their_length(gmsh[0])
    vtu.zlib, vtu.lzma = _Unpacker(zlib.decompressobj), _Unpacker(lzma.LZMADecompressor)
    vtu.vtk_cells_from_data = vtk.vtk_cells_from_data = _whole(shared)


class _Unpacker:
    """Stands for a module that unpacks, until the data of one file have grown too large."""

    left = 0  # bytes, of all unpackers together

    def __init__(self, start: Any) -> None:
        self._start = start

    def decompress(self, data: bytes) -> bytes:
        """Return the unpacked bytes."""
        unpacking = self._start()
        found = unpacking.decompress(data, max(_Unpacker.left, 1))
        _Unpacker.left -= len(found)
        if _Unpacker.left <= 0:
            raise meshio.ReadError("its data unpack to more than a file of its size should hold")
        if not unpacking.eof:
            raise meshio.ReadError("its packed data end too early")
        return found


class _Ending:
    """A file that does not let a reader look for more after its end for ever."""

    ends = 0

    def readline(self, *size: Any) -> Any:
        """Return the next line; raise an error when it is asked for too often after the last."""
        return self._counted(super().readline(*size))  # type: ignore[misc]

    def read(self, *size: Any) -> Any:
        """Return what is left, or so much of it; raise an error as `readline` does."""
        return self._counted(super().read(*size))  # type: ignore[misc]

    def _counted(self, found: Any) -> Any:
        self.ends += not found
        if self.ends > MOST_ENDS:
            raise meshio.ReadError("it ends too early")
        return found


class _Bytes(_Ending, io.BufferedReader): ...


class _Text(_Ending, io.TextIOWrapper): ...


def _open(name: Any, mode: str = "r", *more: Any, **options: Any) -> Any:
    if mode == "rb" and not more and not options:
        return _Bytes(io.FileIO(name))
    if mode == "r" and not more and not options:
        return _Text(io.BufferedReader(io.FileIO(name)))
    return open(name, mode, *more, **options)


def _end_block(file: Any, block: str) -> None:
    """Go to the end of a block of a Gmsh file; blocks that were read must be read to their end."""
    read = ("MeshFormat", "PhysicalNames", "Entities", "Nodes", "Elements", "Periodic")
    for line in file:
        if line.strip() == f"$End{block}".encode():
            return
        if line.strip() and block in (*read, "NodeData", "ElementData"):
            raise meshio.ReadError(f"${block} holds more than it declares, or something else")
    raise meshio.ReadError(f"it ends too early, in ${block}")


def _nothing(shape: Any, dtype: Any = float) -> np.ndarray:
    return np.full(shape, np.nan if np.dtype(dtype).kind == "f" else -1, dtype)


def _listed(read_nodes: Any) -> Any:
    def checked(*args: Any) -> Any:
        found = read_nodes(*args)
        if np.min(found[1], initial=0) < 0:
            raise meshio.ReadError("$Nodes lists fewer nodes than it declares, or one of number 0")
        return found

    return checked


def _numbered_once(read_nodes: Any, first: int = 0) -> Any:
    """Return a reader that refuses nodes with one number, of which meshio uses the last.

    Args:
        read_nodes: Returns points and, beside them, their numbers or places by number.
        first: What is added to the numbers.
    """

    def checked(*args: Any) -> Any:
        found = read_nodes(*args)
        for part in found:
            if isinstance(part, dict):  # from numbers to places, in which the last is kept
                points = next(len(p) for p in found if isinstance(p, np.ndarray))
                if lost := sorted(set(range(points)) - set(part.values())):
                    raise meshio.ReadError(
                        f"{len(lost)} nodes have the number of a later one: those in the places "
                        f"{', '.join(map(str, lost[:5]))} (counted from 0); number each node once"
                    )
                return found
        _once(np.asarray(found[1]).astype(np.int64) + first)
        return found

    return checked


def _once(numbers: Any) -> None:
    """Raise where a node number is listed twice."""
    found, count = np.unique(numbers, return_counts=True)
    if twice := [int(number) for number in found[count > 1]]:
        raise meshio.ReadError(
            f"{len(twice)} node numbers are listed more than once: "
            f"{', '.join(map(str, twice[:5]))}; number each node once"
        )


def _counted_from_one(ordered: Any) -> Any:
    def checked(kind: str, nodes: np.ndarray) -> np.ndarray:
        if np.size(nodes) and np.min(nodes) < 0:  # would count from the last one
            raise meshio.ReadError(f"cells name node {np.min(nodes) + 1}, nodes count from 1")
        return ordered(kind, nodes)

    return checked


def _of_their_length(gmsh22: Any) -> Any:
    read_cells = gmsh22._read_cells_ascii

    def checked(file: Any, cells: Any, tags: Any, total: int) -> None:
        start = file.tell()
        for _ in range(total):
            row = file.readline().split()
            kind = gmsh22._gmsh_to_meshio_type[int(row[1])]
            if len(row) != 3 + int(row[2]) + gmsh22.num_nodes_per_cell[kind]:
                raise meshio.ReadError(
                    f"element {row[0].decode()[:20]} is no {kind}, by its length"
                )
        file.seek(start)
        read_cells(file, cells, tags, total)

    return checked


def _whole(shared: types.ModuleType) -> Any:
    known = {
        number: shared.num_nodes_per_cell[name]
        for number, name in shared.vtk_to_meshio_type.items()
        if name in shared.num_nodes_per_cell
    }
    cells_from_data = shared.vtk_cells_from_data

    def checked(connectivity: Any, offsets: Any, types: Any, data: Any) -> Any:
        sizes = np.diff(offsets.astype(np.int64), prepend=0)
        if (sizes < 0).any() or sizes.sum() != len(connectivity):
            raise meshio.ReadError("the offsets of its cells do not fit their nodes")
        for kind in np.unique(types):
            if int(kind) not in shared.vtk_to_meshio_type:  # would be left out
                raise meshio.ReadError(f"it holds cells of VTK's type {kind}; convert them")
            if int(kind) in known and (sizes[types == kind] != known[int(kind)]).any():
                raise meshio.ReadError(f"cells of type {kind} have {known[int(kind)]} nodes")
        return cells_from_data(connectivity, offsets, types, data)

    return checked


if __name__ == "__main__":
    main()

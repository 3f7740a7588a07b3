"""Program that reads a mesh file with meshio for `dpl.fem.mesh.sandbox`, under limits.

Its arguments are the path, the limit of memory [B] and the limit of CPU time [s]. It writes an
archive of NumPy (.npz) to the standard output: the arrays by number and, as "answer", a text in
JSON: the arguments of `meshio.Mesh` with these numbers, or an error.
"""

import contextlib
import io
import json
import os
import sys
import warnings
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from dpl.fem.mesh.abaqus import read_inp
from dpl.fem.mesh.sandbox_checks import CONVERT, Refused, check_counts, check_file, read_vtu

LIBRARIES = tuple({os.path.realpath(path) for path in (sys.prefix, sys.base_prefix, *sys.path)})
READERS = {".vtu": read_vtu, ".inp": read_inp}  # others are meshio's
FORBIDDEN = (  # audit events
    "socket.", "subprocess.", "shutil.", "os.exec", "os.fork", "os.posix_spawn", "os.spawn",
    "os.system", "os.remove", "os.rename", "os.truncate", "os.mkdir", "os.rmdir", "os.link",
)  # fmt: skip


def main() -> None:
    """Answer for one file."""
    path, memory, seconds = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # for readers that print
    set_limits(memory, seconds)
    restrict_access(os.path.realpath(path))
    arrays: dict[str, np.ndarray] = {}
    answer = read(path, arrays)
    np.savez(output, answer=np.array(json.dumps(answer)), **arrays)  # type: ignore[arg-type]
    output.flush()


def set_limits(memory: int, seconds: int) -> None:
    """Limit the memory [B] and the CPU time [s] from now on, and forbid files to grow."""
    try:
        import resource
    except ImportError:  # Windows: `dpl.fem.mesh.sandbox` limits the elapsed time
        return
    pages = Path("/proc/self/statm")
    used = int(pages.read_text().split()[0]) * resource.getpagesize() if pages.exists() else 0
    for limit, bound in (
        (resource.RLIMIT_AS, used + memory),
        (resource.RLIMIT_CPU, 1 + seconds),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(limit)[1]
        soft = bound if hard == resource.RLIM_INFINITY else min(bound, hard)
        with contextlib.suppress(ValueError, OSError):  # macOS does not limit memory
            resource.setrlimit(limit, (soft, hard))


def restrict_access(own: str) -> None:
    """Refuse other files than `own` and those of Python, programs and the network from now on.

    HDF5 is refused too: files of it can name other files, which its library opens by itself.
    """

    def check(event: str, args: tuple[Any, ...]) -> None:
        if event.startswith(FORBIDDEN):
            raise Refused(f"its reader calls {event}, which no mesh needs")
        if event == "import" and args[0] in ("h5py", "netCDF4"):
            raise Refused(f"its format needs {args[0]}, {CONVERT}")
        if event == "open" and isinstance(args[0], (str, bytes, os.PathLike)):
            path = os.path.realpath(os.fsdecode(args[0]))
            writes = args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            if writes or (path != own and not path.startswith(LIBRARIES)):
                raise Refused(f"it includes another file ({path[-80:]!r}); join them in one")

    sys.addaudithook(check)


def read(path: Path, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the answer for a file, and add its arrays by number."""
    printed = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(printed),
            contextlib.redirect_stderr(printed),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", ".*could not be read to its end")
            check_file(path)
            mesh = READERS.get(path.suffix.lower(), meshio.read)(path)
            check_counts(path, mesh)
            return encode(mesh, arrays)
    except MemoryError:
        arrays.clear()
        return {"error": "it takes more memory than a file of its size should; save it again"}
    except SystemExit:  # meshio ends the program after it has printed the causes
        text = printed.getvalue().split("Error:")[0]
    except (Refused, meshio.ReadError, ImportError) as error:
        text = str(error)
    except Exception as error:
        text = f"it is damaged or ends too early ({error})"
    text = "".join(c if c.isprintable() else " " for c in text)
    return {"error": " ".join(text.split())[:500] or "it is damaged or ends too early"}


def encode(mesh: meshio.Mesh, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the arguments of `meshio.Mesh`, with numbers in place of the arrays."""

    def add(values: Any) -> int:
        array = np.asarray([] if values is None else values)
        if array.dtype.kind not in "biuf":
            raise Refused("its nodes, cells or sets are not numbers")
        arrays[str(len(arrays))] = array
        return len(arrays) - 1

    def add_blocks(data: dict[str, Any]) -> dict[str, list[int]]:
        return {name: [add(block) for block in blocks] for name, blocks in data.items()}

    fields = {n: v for n, v in mesh.point_data.items() if np.asarray(v).dtype.kind in "biu"}
    groups = {n: v for n, v in mesh.field_data.items() if np.size(v) == 2}
    sets = {n: v for n, v in mesh.cell_sets.items() if n and not n.startswith("gmsh:")}
    return {
        "points": add(mesh.points),
        "cells": [{"cell_type": b.type, "data": add(b.data)} for b in mesh.cells],
        "point_data": {name: add(values) for name, values in fields.items()},
        "cell_data": add_blocks(mesh.cell_data),
        "field_data": {name: add(values) for name, values in groups.items()},
        "point_sets": {name: add(members) for name, members in mesh.point_sets.items()},
        "cell_sets": add_blocks(sets),
    }


if __name__ == "__main__":
    main()

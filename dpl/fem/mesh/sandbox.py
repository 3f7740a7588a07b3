"""Read mesh files that are not trusted: meshio runs in a process of its own, with limits.

The process may use memory and CPU time in proportion to the size of the file. It may not open other
files, write, start programs or use the network. It is ended after a time limit, and it returns
numbers and names only.
"""

import io
import json
import math
import os
import signal
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import meshio
import numpy as np

MAX_BYTES = 4 * 2**30  # of a file [B]
MEMORY = (2**30, 100)  # limit of memory [B]: constant, and per byte of the file
SECONDS = (10.0, 2e-6)  # limit of CPU time [s]: constant, and per byte of the file
WAIT = 6.0  # limit of elapsed time, as a multiple of the limit of CPU time
LATE = "it takes longer than a file of its size should; save it again"


def read(path: Path) -> meshio.Mesh:
    """Return the mesh of a file that is not trusted, as meshio reads it.

    Point data are those of integers; data that `dpl.fem.mesh.reading` does not use are left out.
    An error is one line with the name of the file.
    """
    size = _size(path)
    seconds = math.ceil(SECONDS[0] + SECONDS[1] * size)
    program = [sys.executable, "-P", "-m", "dpl.fem.mesh.sandbox_worker"]
    arguments = [str(path.absolute()), str(MEMORY[0] + MEMORY[1] * size), str(seconds)]
    packages = [str(Path(__file__).parents[3]), *filter(None, sys.path)]
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    try:
        done = subprocess.run(
            [*program, *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env=os.environ | threads | {"PYTHONPATH": os.pathsep.join(packages)},
            timeout=WAIT * seconds, check=False,
        )  # fmt: skip
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as arrays:
            answer = json.loads(str(arrays["answer"]))
            if "error" not in answer:
                answer = _decode(answer, arrays)
    except subprocess.TimeoutExpired:
        answer = {"error": LATE}
    except (EOFError, OSError, ValueError, zipfile.BadZipFile):  # it ended before its answer
        late = done.returncode == -getattr(signal, "SIGXCPU", 0)
        answer = {"error": LATE if late else f"the reader crashed (status {done.returncode})"}
    if "error" in answer:
        raise ValueError(f"{path}: cannot be read as a mesh: {answer['error']}")
    answer["cells"] = [meshio.CellBlock(**block) for block in answer["cells"]]
    return meshio.Mesh(**answer)


def _size(path: Path) -> int:
    """Return the size of a regular file [B]."""
    if os.path.isdir(path):
        raise FileNotFoundError(f"{path}: is a folder, not a mesh file")
    if not os.path.exists(path):
        raise FileNotFoundError(f"{path}: no such mesh file")
    if not os.path.isfile(path):
        raise ValueError(f"{path}: is a device or a pipe; copy its data into a file")
    size, limit = path.stat().st_size, MAX_BYTES // 2**30
    if size > MAX_BYTES:
        raise ValueError(
            f"{path}: size = {size / 2**30:.1f} GiB must be at most {limit} GiB; split the mesh"
        )
    return size


def _decode(value: Any, arrays: Any) -> Any:
    """Return a tree of dictionaries and lists with the arrays in place of their numbers."""
    if isinstance(value, dict):
        return {name: _decode(part, arrays) for name, part in value.items()}
    if isinstance(value, list):
        return [_decode(part, arrays) for part in value]
    return arrays[str(value)] if isinstance(value, int) else value

"""Files of data sets, as several tests of this folder compare them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.torch import load_file, save

from dpl.data import Store
from dpl.data.solving.solve import SolvedLoad
from dpl.data.storage.integrity import verify
from dpl.data.storage.shard import Columns, digest


def content(folder: Path) -> dict[str, bytes]:
    """Return all that must not depend on how the data set was made, byte for byte."""
    return {path.name: path.read_bytes() for path in folder.glob("*.safetensors")}


def fields_of(one: SolvedLoad) -> dict[str, Any]:
    """Return the fields of a solved load that do not depend on a clock, as comparable values."""
    fields = {name: value for name, value in one._asdict().items() if name != "seconds"}
    return {k: v.tobytes() if isinstance(v, np.ndarray) else v for k, v in fields.items()}


def flaws(store: Store) -> dict[str, str]:
    """Return the damaged files with what is wrong."""
    return {path.name: flaw for path, flaw in verify(store) if flaw}


def falsify(path: Path, change: Callable[[Columns], object]) -> None:
    """Change the columns of a shard and its digest, as an intruder would."""
    columns = load_file(path)
    change(columns)
    path.write_bytes(save(columns, {"sha256": digest(path.name, columns)}))

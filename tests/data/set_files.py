"""Files of data sets, as several tests of this folder compare them."""

from collections.abc import Callable
from pathlib import Path

from safetensors.torch import load_file, save

from dpl.data import Store
from dpl.data.storage.integrity import verify
from dpl.data.storage.shard import Columns, digest


def content(folder: Path) -> dict[str, bytes]:
    """Return all that must not depend on how the data set was made, byte for byte."""
    return {path.name: path.read_bytes() for path in folder.glob("*.safetensors")}


def flaws(store: Store) -> dict[str, str]:
    """Return the damaged files with what is wrong."""
    return {path.name: flaw for path, flaw in verify(store) if flaw}


def falsify(path: Path, change: Callable[[Columns], object]) -> None:
    """Change the columns of a shard and its digest, as an intruder would."""
    columns = load_file(path)
    change(columns)
    path.write_bytes(save(columns, {"sha256": digest(path.name, columns)}))

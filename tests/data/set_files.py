"""Files of data sets, as several tests of this folder compare them."""

import json
from pathlib import Path

from dpl.data import Store
from dpl.data.storage.integrity import verify


def lines(store: Store) -> list[dict]:
    """Return the lines of the manifest."""
    return [json.loads(line) for line in (store.folder / "manifest.jsonl").read_text().splitlines()]


def content(folder: Path) -> dict[str, bytes]:
    """Return all that must not depend on how the data set was made, byte for byte."""
    return {
        p.name: p.read_bytes() for p in [*folder.glob("*.safetensors"), *folder.glob("m*.jsonl")]
    }


def flaws(store: Store) -> dict[str, str]:
    """Return the damaged files with what is wrong."""
    return {part.file: flaw for part, flaw in verify(store) if flaw}

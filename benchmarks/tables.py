"""Tables of results: read the rows of a dataclass again; write the machine beside them."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from dpl.evaluation.tables import machine

Row = TypeVar("Row")
READERS: dict[Any, Callable[[str], Any]] = {
    str: str,
    int: int,
    float: lambda cell: float(cell or "nan"),
    bool: lambda cell: cell == "True",
    int | None: lambda cell: int(cell) if cell else None,
    float | None: lambda cell: float(cell) if cell else None,
    tuple[int, ...]: lambda cell: tuple(int(part) for part in cell.strip("()").split(",") if part),
}


def read(kind: type[Row], path: Path) -> list[Row]:
    """Return the rows of a CSV file written by `write`, whose dataclass has fields of `READERS`.

    Raises:
        ValueError: The file has other columns.
    """
    readers = {name: READERS[hint] for name, hint in get_type_hints(kind).items()}
    with path.open(newline="") as file:
        lines = csv.DictReader(file)
        if lines.fieldnames != list(readers):
            raise ValueError(f"{path} must have the columns {', '.join(readers)}")
        return [kind(**{name: readers[name](cell) for name, cell in row.items()}) for row in lines]


def write_machine(path: Path, *, threads: int = 1) -> None:
    """Write machine and number of threads as JSON."""
    path.write_text(json.dumps({"machine": machine(), "threads": threads}) + "\n")

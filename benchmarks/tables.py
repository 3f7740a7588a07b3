"""Tables of results: print rows of a dataclass and read them again; the machine beside them."""

import csv
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from dpl.evaluation.tables import show_cells, text

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


def show(rows: Sequence[Any], title: str) -> None:
    """Print rows of a dataclass, one column for each field."""
    columns = [field.name.replace("_", " ") for field in fields(rows[0])]
    show_cells(title, columns, [[text(value, 3) for value in astuple(row)] for row in rows])


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


def machine() -> str:
    """Return processor and number of cores of this machine."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{models[0] if models else 'unknown processor'}, {os.cpu_count()} cores"


def write_machine(path: Path, *, threads: int = 1) -> None:
    """Write machine and number of threads as JSON."""
    path.write_text(json.dumps({"machine": machine(), "threads": threads}) + "\n")

"""Results as rows: frozen dataclasses, shown as tables and written as CSV."""

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table


def show(rows: Sequence[Any], title: str) -> None:
    """Print rows of one dataclass, a column for each field."""
    table = Table(title=title, title_justify="left")
    for field in fields(rows[0]):
        table.add_column(field.name.replace("_", " "))
    for row in rows:
        table.add_row(*(text(value, 3) for value in asdict(row).values()))
    Console(width=max(Console().width, 200)).print(table)


def write(rows: Sequence[Any], path: Path) -> None:
    """Write rows of one dataclass as CSV; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([field.name for field in fields(rows[0])])
        writer.writerows([text(value, 4) for value in asdict(row).values()] for row in rows)


def write_machine(machine: str, path: Path, *, threads: int = 1) -> None:
    """Write on what rows were measured, as JSON."""
    path.write_text(json.dumps({"machine": machine, "threads": threads}) + "\n")


def text(value: object, digits: int) -> str:
    """Return a value as text, a float to so many digits; what is not known is empty."""
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.{digits}g}"
    return "" if value is None else str(value)

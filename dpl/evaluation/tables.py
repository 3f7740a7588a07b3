"""Tables whose rows are instances of a frozen dataclass: print, and write as CSV.

The names of the rows of an evaluation stand here, so that `compare` need not import torch.
"""

import csv
import io
import math
import os
from collections.abc import Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape  # a unit such as [m] is no markup
from rich.table import Table

from dpl.system.files import atomic_write

PREDICTION = "prediction"  # name of the row of the bare model
SIMULATOR, NETWORK = "sim(force)", "bare network"  # names of the two latencies
TOLS = (1e-3, 1e-6)  # relative residuals of simulator and Newton [-]


def show(rows: Sequence[Any], title: str) -> None:
    """Print rows of a dataclass, one column for each field.

    A field may have a unit in its metadata. Numbers whose unit is "%" are stored relative to 1.
    """
    units = [field.metadata.get("unit", "") for field in fields(rows[0])]
    columns = [
        field.name.replace("_", " ") + (f" [{unit}]" if unit not in ("", "%") else "")
        for field, unit in zip(fields(rows[0]), units, strict=True)
    ]
    cells = [
        [
            share(value) if unit == "%" and not math.isnan(value) else text(value, 3)
            for value, unit in zip(astuple(row), units, strict=True)
        ]
        for row in rows
    ]
    show_cells(title, columns, cells)


def show_cells(
    title: str, columns: Sequence[str], *sections: Sequence[Sequence[str]], space: int = 2
) -> None:
    """Print rows of text with lines between sections; the first column is aligned to the left.

    Words of a title stand below each other, so that columns are as narrow as their numbers.
    `space` is the number of characters between columns.
    """
    table = Table(
        title=escape(title) or None, title_justify="left", title_style="", box=box.SIMPLE_HEAD,
        pad_edge=False, padding=(0, space - 1, 0, 0),
    )  # fmt: skip
    for number, column in enumerate(columns):
        words = column.replace(" ", "\n") if number else column
        table.add_column(escape(words), justify="right" if number else "left", no_wrap=True)
    for rows in sections:
        for row in rows:
            table.add_row(*map(escape, row))
        table.add_section()
    Console(width=max(Console().width, 200)).print(table)


def simulator_row(tol: float) -> str:
    """Return the name of the row of the simulator with a tolerance."""
    return f"sim(force, tol={power(tol)})"


def newton_row(tol: float) -> str:
    """Return the name of the row of Newton's method from rest to a tolerance."""
    return f"Newton, tol={power(tol)}"


def share(number: float) -> str:
    """Return a relative number in percent with two digits, in powers of ten below 0.001 %."""
    return f"{percent(number)} %" if 1e-5 <= number < math.inf else f"{number:.0e}"


def percent(number: float) -> str:
    """Return 100 times a relative number with two digits, with one digit below 0.001."""
    number = 100 * number
    if not 1e-3 <= number < math.inf:
        return f"{number:.0e}"
    return f"{number:.{max(0, 1 - math.floor(math.log10(number)))}f}"


def power(number: float) -> str:
    """Return a number without zeros in its exponent, such as 1e-3 or 2.5e-8."""
    mantissa, exponent = f"{number:e}".split("e")
    return f"{float(mantissa):g}e{int(exponent)}"


def write(rows: Sequence[Any], path: Path) -> None:
    """Write rows of a dataclass as CSV, atomically; missing folders are created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = io.StringIO(newline="")
    writer = csv.writer(lines)
    writer.writerow([field.name for field in fields(rows[0])])
    writer.writerows([text(value, 4) for value in astuple(row)] for row in rows)
    with atomic_write(path) as file:
        file.write(lines.getvalue().encode())


def machine() -> str:
    """Return processor and number of cores of this machine."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{models[0] if models else 'unknown processor'}, {os.cpu_count()} cores"


def text(value: object, digits: int) -> str:
    """Return a value as text, floats with `digits` significant digits, None and NaN as empty."""
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.{digits}g}"
    return "" if value is None else str(value)

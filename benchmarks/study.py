"""What all studies do with their rows: write, print, read and draw them."""

import csv
import io
import itertools
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from dpl.evaluation.tables import machine, show, write
from dpl.visualization import COLOURS, DPI, STYLE

Array = NDArray[np.float64]
Row = TypeVar("Row")
Draw = Callable[[Sequence[Row], Path], None]
METHOD_COLOURS = {  # a method has the same colour in all figures
    "Newton": "0.1",
    "linear": "0.5",
    "unrolled": COLOURS[0],
    "fcnn": COLOURS[1],
    "pod": COLOURS[2],
    "cnn": COLOURS[3],
    "gnn": COLOURS[4],
    "POD-Galerkin": COLOURS[5],
    "paper": "#7F3C8D",
}
OTHER_COLOURS = ("#A5AA99", "#80BA5A", "#E73F74", "#8C564B")  # of methods without an own colour
WIDTH = 7.4  # of all figures [inch]: 7.5 points are 10 pixels on a page with pictures of 700 pixels
READERS: dict[Any, Callable[[str], Any]] = {
    str: str,
    int: int,
    float: lambda cell: float(cell or "nan"),
    bool: lambda cell: cell == "True",
    int | None: lambda cell: int(cell) if cell else None,
    float | None: lambda cell: float(cell) if cell else None,
    tuple[int, ...]: lambda cell: tuple(int(part) for part in cell.strip("()").split(",") if part),
}


def method_colours(names: Iterable[str]) -> dict[str, str]:
    """Return the colours of methods by name: those of `METHOD_COLOURS`, else further ones.

    Variants of a method, such as fcnn_plain and "fcnn, hybrid", have its colour.
    """
    others = itertools.cycle(OTHER_COLOURS)
    methods = {name: re.split(r"[_, ]", name, maxsplit=1)[0] for name in names}
    own = {one: METHOD_COLOURS.get(one) or next(others) for one in dict.fromkeys(methods.values())}
    return {name: own[method] for name, method in methods.items()}


def record(
    rows: Iterable[Row],
    stem: Path,
    title: str | None,
    draw: Draw[Row] | None = None,
    *,
    threads: int = 1,
    facts: Mapping[str, str | int | None] = {},  # not changed
) -> list[Row]:
    """Write rows as CSV, each as soon as it is measured; print them; write machine and figure.

    Rows are instances of one frozen dataclass, whose fields are the columns. Without a title they
    are not printed. `stem` is the path of the files without extension.
    """
    measured: list[Row] = []
    for row in rows:
        measured.append(row)
        write(measured, stem.with_name(f"{stem.name}.csv"))
    if measured:
        if title is not None:
            show(measured, title)
        write_machine(stem.with_name(f"{stem.name}.json"), threads=threads, **facts)
        if draw is not None:
            draw(measured, stem.with_name(f"{stem.name}.png"))
        print(f"written to {stem}.csv", flush=True)
    return measured


def read(kind: type[Row], path: Path) -> list[Row]:
    """Return the rows of a CSV file written by `write`, whose dataclass has fields of `READERS`."""
    readers = {name: READERS[hint] for name, hint in get_type_hints(kind).items()}
    with path.open(newline="") as file:
        lines = csv.DictReader(file)
        if lines.fieldnames != list(readers):
            raise ValueError(f"{path} must have the columns {', '.join(readers)}")
        return [kind(**{name: readers[name](cell) for name, cell in row.items()}) for row in lines]


def write_machine(path: Path, **facts: str | int | None) -> None:
    """Write the name of the machine and further facts as JSON."""
    path.write_text(json.dumps({"machine": machine(), **facts}) + "\n")


@contextmanager
def picture(path: Path, height: float = 3.1) -> Iterator[Any]:
    """Yield an empty figure of page width, and of a height [inch]; write it at the end."""
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from PIL import Image

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, height))
        figure.set_layout_engine("constrained", w_pad=0.06, wspace=0.05)
        yield figure
        drawn = io.BytesIO()
        figure.savefig(drawn, dpi=DPI)
    path.parent.mkdir(parents=True, exist_ok=True)
    palette = Image.open(drawn).convert("RGB").quantize(128)  # a third of the size
    palette.save(path, optimize=True)


def label_decades(axis: Any, form: str = "{x:g}") -> None:
    """Put labelled ticks at 1, 2 and 5 of each decade of an axis."""
    from matplotlib.ticker import LogLocator

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(form)
    axis.set_minor_formatter("")


def dots(
    ax: Any,
    names: Sequence[str],
    filled: Sequence[float | None],
    hollow: Sequence[float | None],
    colours: Sequence[str],
) -> None:
    """Draw a row for each name: a filled and a hollow dot, each where its value is known."""
    for row, (*pair, colour) in enumerate(zip(filled, hollow, colours, strict=True)):
        known = [value for value in pair if value is not None and math.isfinite(value)]
        ax.plot(known, [row] * len(known), color=colour, lw=0.8, alpha=0.5)
        for value, face in zip(pair, (colour, "white"), strict=True):
            if value is not None:
                ax.plot(value, row, "o", color=colour, mfc=face, ms=4.5)
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.tick_params(axis="y", length=0)
    ax.grid(visible=True)


def dots_legend(figure: Any, filled: str, hollow: str) -> None:
    """Explain the dots of `dots` below a figure."""
    from matplotlib.lines import Line2D

    style: dict[str, Any] = {"color": "0.4", "marker": "o", "ls": "", "ms": 4.5}
    faces = {filled: "0.4", hollow: "white"}
    handles = [Line2D([], [], mfc=face, label=words, **style) for words, face in faces.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)

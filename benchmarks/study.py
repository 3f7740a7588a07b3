"""What all studies do with their rows: write, print and draw them."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from benchmarks.tables import read, write_machine
from dpl.evaluation.tables import show, write
from dpl.visualization import COLOURS, DPI, STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
}
OTHER_COLOURS = ("#7F3C8D", "#A5AA99", "#80BA5A", "#E73F74")  # of methods without an own colour


def method_colours(names: Iterable[str]) -> dict[str, str]:
    """Return the colours of methods by name: those of `METHOD_COLOURS`, else further ones."""
    others = itertools.cycle(OTHER_COLOURS)
    return {name: METHOD_COLOURS.get(name) or next(others) for name in names}


def record(
    rows: Iterable[Row],
    stem: Path,
    title: str | None,
    draw: Draw[Row] | None = None,
    *,
    threads: int = 1,
) -> list[Row]:
    """Write rows as CSV, each as soon as it is measured; print them; write machine and figure.

    Args:
        rows: Instances of one frozen dataclass, whose fields are the columns.
        stem: Path of the files without extension.
        title: Title of the printed table; None: the rows are not printed.
        draw: Draws the rows to a path; None: there is no figure.
        threads: Number of threads of the measurement, for the record.

    Returns:
        The rows.
    """
    measured: list[Row] = []
    for row in rows:
        measured.append(row)
        write(measured, stem.with_name(f"{stem.name}.csv"))
    if measured:
        if title is not None:
            show(measured, title)
        write_machine(stem.with_name(f"{stem.name}.json"), threads=threads)
        if draw is not None:
            draw(measured, stem.with_name(f"{stem.name}.png"))
        print(f"written to {stem}.csv", flush=True)
    return measured


def redraw(kind: type[Row], path: Path, draw: Draw[Row], *, stem: str | None = None) -> None:
    """Draw the rows of a CSV file to the picture beside it, if there is such a file.

    Args:
        kind: Class of the rows.
        path: The file.
        draw: Draws the rows to a path.
        stem: Name of the picture without extension; None: that of the file.
    """
    if path.is_file():
        draw(read(kind, path), path.with_name(f"{stem or path.stem}.png"))


@contextmanager
def picture(path: Path, width: float, height: float) -> Iterator["Figure"]:
    """Yield an empty figure in the style of the package and write it to a file at the end.

    Args:
        path: Path of the picture.
        width, height: Size [inch].
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=DPI)

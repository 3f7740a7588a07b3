"""What all studies do with their rows: write, print and draw them."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from benchmarks.tables import read, write_machine
from dpl.evaluation.tables import show, write
from dpl.visualization import DPI, STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = TypeVar("Row")
Draw = Callable[[Sequence[Row], Path], None]


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

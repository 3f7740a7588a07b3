"""Rows are read as they were written, and all figures are drawn from rows, in one style."""

import csv
import itertools
from dataclasses import dataclass, fields

import numpy as np
import pytest
from PIL import Image

from benchmarks import CONF, deflections, results
from benchmarks.study import WIDTH, dots, picture, read
from dpl.evaluation.tables import write
from dpl.visualization import DPI

RESULTS = CONF.parent / "results"
DIAGRAMS = {"unrolled_method"}  # drawn from a model


@dataclass(frozen=True)
class Row:
    """A row with a column of each kind."""

    name: str
    count: int
    error: float
    is_final: bool
    samples: int | None
    minutes: float | None
    cells: tuple[int, ...]


def test_rows_are_read_as_they_were_written(tmp_path):
    rows = [
        Row("a", 1, 0.5, True, None, None, (4, 1, 1)),
        Row("b, c", 2, 2e-9, False, 3, 1.5, (2,)),
    ]
    write(rows, tmp_path / "rows.csv")
    assert read(Row, tmp_path / "rows.csv") == rows
    with pytest.raises(ValueError, match=r"rows\.csv must have the columns body, load"):
        read(deflections.Deflection, tmp_path / "rows.csv")


def test_every_published_figure_belongs_to_rows_of_its_name():
    columns = [[field.name for field in fields(kind)] for kind, _ in results.figures()]
    assert all(a != b for a, b in itertools.combinations(columns, 2)), "columns tell the class"
    drawable = set()
    for path in RESULTS.glob("*.csv"):
        with path.open(newline="") as file:
            if next(csv.reader(file)) in columns:
                drawable.add(path.stem)
    assert {path.stem for path in RESULTS.glob("*.png")} - DIAGRAMS == drawable


def test_figures_are_drawn_again_by_the_columns_of_their_rows(script, tmp_path):
    rows = [deflections.Deflection(body, k, 0.1 * k) for body in "ab" for k in range(1, 4)]
    write(rows, tmp_path / "bent.csv")
    write([Row("a", 1, 0.5, True, None, None, ())], tmp_path / "other.csv")
    ended = script("results", "name=figures", f"folder={tmp_path}", cwd=tmp_path)
    assert ended.status == 0, ended.err
    assert [path.name for path in tmp_path.glob("*.png")] == ["bent.png"]
    drawn = Image.open(tmp_path / "bent.png")
    assert drawn.width == pytest.approx(WIDTH * DPI, abs=1), "page width"
    assert np.ptp(np.asarray(drawn.convert("L"))) > 100


def test_a_row_of_dots_has_those_whose_values_are_known(tmp_path):
    with picture(tmp_path / "a.png", 2.0) as figure:
        ax = figure.subplots()
        dots(ax, ["a", "b"], [0.1, None], [1.0, 0.5], ["0.1", "0.5"])
    places = [line.get_xydata().tolist() for line in ax.lines if line.get_marker() == "o"]
    assert places == [[[0.1, 0.0]], [[1.0, 0.0]], [[0.5, 1.0]]]

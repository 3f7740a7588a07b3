"""Laws of cost against size: each size measured alone, exponents are slopes."""

import csv

import pytest

from benchmarks import sizes as beams
from benchmarks.study import METHOD_COLOURS
from dpl.evaluation.tables import write


@pytest.mark.slow
def test_each_size_is_measured_in_a_process_of_its_own(tmp_path):
    rows = [row for part in beams.sizes([2, 3], loads=2) for row in part]
    assert sorted({row.dofs for row in rows}) == [3 * 9 * 9, 3 * 13 * 16]
    whole = [row for row in rows if row.case.startswith("fcnn")]
    assert [row.parameters for row in whole] == [4 * n**2 + 7 * n for n in (243, 624)]
    assert all(row.peak_memory_mb > 100 for row in rows)
    write(rows, tmp_path / "sizes.csv")
    beams.draw(rows, tmp_path / "sizes.png")
    assert len(list(csv.DictReader((tmp_path / "sizes.csv").open()))) == len(rows)
    assert (tmp_path / "sizes.png").stat().st_size > 10_000


def test_exponents_are_slopes():
    sizes = [10, 100, 1000]
    assert beams.exponent(sizes, [3e-4 * n**1.5 for n in sizes]) == pytest.approx(1.5)
    assert beams.exponent([10], [1.0]) != beams.exponent([10], [1.0])


def test_no_panel_has_more_than_four_lines(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **options: drawn.append(figure))
    cases = ["factor of K(0), analysis included (band)", "linear solution", "Newton"]
    cases += ["Newton, corotational, from a guess", "unrolled", "fcnn, as in the paper"]
    rows = [beams.Size(case, n, 1.0 * n, n, 1.0 * n, n) for case in cases for n in (100, 1000)]
    beams.draw(rows, tmp_path / "sizes.png")
    (figure,) = drawn
    assert [len(ax.lines) for ax in figure.axes] == [4, 2, 1, 3]
    labels = {text.get_text(): text.get_color() for text in figure.axes[1].texts}
    names = ("unrolled", "fcnn")
    assert labels == {f"{name} $\\sim$ DOFs$^{{1.00}}$": METHOD_COLOURS[name] for name in names}
    assert [line.get_color() for line in figure.axes[1].lines] == list(labels.values())

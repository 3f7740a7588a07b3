"""Laws of cost against size: each size measured alone, exponents are slopes."""

import csv

import pytest

from benchmarks import sizes as beams
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

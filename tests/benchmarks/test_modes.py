"""Laws of the times of eigenmodes: positive, a row for each beam, the paper's row beside them."""

from benchmarks import modes
from benchmarks.tables import read
from dpl.evaluation.tables import write


def test_each_beam_has_its_modes_and_times(tmp_path):
    rows = list(modes.mode_times([(5, 3, 3), (7, 3, 3)], count=1, repeats=2))
    assert [row.dofs for row in rows] == [15_000, 3 * 5 * 9, 3 * 7 * 9]
    assert [row.modes for row in rows] == [None, 2, 2], "a pair of bending modes is not divided"
    assert rows[0].modes_s == 4 * 60 + 20, "the paper: 4 min 20 s"
    assert all(row.factor_s > 0 < row.modes_s for row in rows[1:])
    write(rows, tmp_path / "modes.csv")
    assert [row.backend for row in read(modes.ModesTime, tmp_path / "modes.csv")] == [
        row.backend for row in rows
    ]

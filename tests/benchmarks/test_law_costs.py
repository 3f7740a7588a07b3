"""Times of bodies of several laws: a row for each, positive, with one isotropic law as unit."""

from benchmarks import law_costs
from benchmarks.tables import read
from dpl.evaluation.tables import write


def test_each_body_has_its_time(tmp_path):
    rows = list(law_costs.law_costs((5, 3, 3), repeats=2))
    assert [row.body for row in rows] == list(law_costs.BODIES)
    assert rows[0].ratio == 1
    assert all(row.ms > 0 < row.ratio and row.dofs == 3 * 5 * 9 for row in rows)
    write(rows, tmp_path / "laws.csv")
    assert all(time > 0 for pair in law_costs.energy_alone_costs((5, 3, 3)) for time in pair)
    assert read(law_costs.LawCost, tmp_path / "laws.csv")[1].body == rows[1].body

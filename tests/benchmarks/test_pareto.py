"""Run time against error: every iterate has a time and an error."""

import pytest

from benchmarks import pareto
from benchmarks.samples import first
from dpl.fem import solve
from dpl.inference import Direct, Hybrid


@pytest.fixture(scope="module")
def rows(scene, batch):
    """Rows of a network with an error of 1e-3, alone and corrected, and of Newton."""
    near = lambda load: 1.001 * solve(scene.solver, load).displacement  # noqa: E731
    solvers = {
        "linear": scene.linear,
        "Newton to 1e-08": scene.solver,
        "near": Direct(near, scene.problem),
        "near, hybrid": Hybrid(near, scene.corrector),
    }
    return pareto.points(solvers, first(batch, 6))


def test_errors_are_those_of_the_iterates(rows):
    by = {(row.solver, row.iteration): row for row in rows}
    assert by["Newton to 1e-08", 0].error == pytest.approx(1.0)
    assert by["Newton to 1e-08", 1].error == pytest.approx(by["linear", 0].error, rel=1e-6)
    assert by["near", 0].error == pytest.approx(1e-3)
    ends = {row.solver: row for row in rows if row.is_final}
    assert ends["Newton to 1e-08"].error < 1e-9
    assert ends["near, hybrid"].max_error < 1e-6
    assert ends["near, hybrid"].residual < 1e-8
    assert ends["near, hybrid"].iteration < ends["Newton to 1e-08"].iteration

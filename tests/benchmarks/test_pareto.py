"""Run time against error: every iterate has a time and an error."""

import pytest

from benchmarks import pareto
from dpl import Sample
from dpl.fem import solve
from dpl.inference import Direct, Hybrid


@pytest.fixture(scope="module")
def batch(scene):
    """Six loads with reference solutions."""
    load = scene.loads.sample((0, 9), range(6))
    return Sample(load.force, solve(scene.solver, load).displacement, load.young)


@pytest.fixture(scope="module")
def solvers(scene):
    """A network with an error of 1e-3, alone and corrected, and Newton."""
    near = lambda load: 1.001 * solve(scene.solver, load).displacement  # noqa: E731
    return {
        "linear": scene.linear,
        "Newton to 1e-08": scene.solver,
        "near": Direct(near, scene.problem),
        "near, hybrid": Hybrid(near, scene.corrector),
    }


@pytest.fixture(scope="module")
def rows(solvers, batch):
    return pareto.points(solvers, batch)


def test_errors_are_those_of_the_iterates(rows):
    by = {(row.solver, row.iteration): row for row in rows}
    assert by["Newton to 1e-08", 0].error == pytest.approx(1.0)
    assert by["Newton to 1e-08", 1].error == pytest.approx(by["linear", 0].error, rel=1e-6)
    assert by["near", 0].error == pytest.approx(1e-3)
    ends = {row.solver: row for row in rows if row.is_final}
    assert ends["Newton to 1e-08"].error < 1e-10
    assert ends["near, hybrid"].max_error < 1e-6
    assert ends["near, hybrid"].residual < 1e-8
    assert ends["near, hybrid"].iteration < ends["Newton to 1e-08"].iteration

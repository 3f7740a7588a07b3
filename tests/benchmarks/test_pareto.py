"""Run time against error: every iterate has a time and an error."""

import csv
import itertools

import pytest
import torch

from benchmarks import pareto
from dpl import Sample
from dpl.evaluation.tables import write
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


def test_every_iterate_has_a_row_with_increasing_times(rows, solvers):
    for name in solvers:
        path = [row for row in rows if row.solver == name]
        assert [row.iteration for row in path] == list(range(len(path)))
        assert [row.is_final for row in path] == [False] * (len(path) - 1) + [True]
        assert all(a.ms <= b.ms for a, b in itertools.pairwise(path))
        assert all(row.ms <= row.ms_p99 for row in path)


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


def test_the_number_of_threads_is_set_and_restored(solvers, batch):
    before = torch.get_num_threads()
    seen = []

    class Spy:
        def iterate(self, load):
            seen.append(torch.get_num_threads())
            return solvers["near"].iterate(load)

    (row,) = pareto.points({"spy": Spy()}, batch, threads=2)
    assert set(seen) == {2}
    assert row.threads == 2
    assert torch.get_num_threads() == before


def test_the_figure_and_the_rows_are_written(rows, tmp_path):
    others = [pareto.Discretisation((4, 1, 1), 1, 60, 3.0, -18.8, 0.34)]
    write(rows, tmp_path / "a.csv")
    pareto.draw(rows, others, 0.01, tmp_path / "a.png")
    pareto.draw(rows, [], None, tmp_path / "b.png")
    sizes = [(tmp_path / name).stat().st_size for name in ("a.png", "b.png")]
    assert sizes[0] > sizes[1] > 10_000
    written = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert [row["solver"] for row in written] == [row.solver for row in rows]


def test_a_law_with_a_range_is_measured_without_pod_galerkin(script, tiny_training, tmp_path):
    kept = [one for one in tiny_training if not one.startswith(("model.", "data.train"))]
    law = ["model=unrolled", "material.poisson=[0.2,0.4]", "data.train=40", "run=runs/e/a"]
    ended = script("train", *kept, *law, cwd=tmp_path)
    assert ended.status == 0, ended.err[-2000:]
    refused = script("pareto", "run=runs/e", cwd=tmp_path)
    assert refused.status == 2
    assert refused.err.startswith("error: galerkin: poisson = [0.2, 0.4] must be one number")
    assert refused.err.count("\n") == 1
    ended = script("pareto", "run=runs/e", "galerkin=null", cwd=tmp_path)
    assert ended.status == 0, ended.err[-2000:]
    path = tmp_path / "runs" / "pareto" / "pareto_e.csv"
    error = {row["solver"]: float(row["error"]) for row in csv.DictReader(path.open())}
    assert error["a, corrected"] < error["a"] < error["linear"]


def test_reduced_models_of_a_run_on_a_stream_are_made_from_its_validation_loads(
    script, tiny_training, tmp_path
):
    kept = [one for one in tiny_training if not one.startswith("data.train")]
    stream = [
        "data=online",
        "data.train.batches=1",
        "data.train.capacity=8",
        "trainer.max_epochs=1",
    ]
    ended = script("train", *stream, *kept, "run=runs/e/a", cwd=tmp_path)
    assert ended.status == 0, ended.err[-2000:]
    ended = script("pareto", "run=runs/e", "galerkin.rank=4", cwd=tmp_path)
    assert ended.status == 0, ended.err[-2000:]
    path = tmp_path / "runs" / "pareto" / "pareto_e.csv"
    assert "POD-Galerkin" in {row["solver"] for row in csv.DictReader(path.open())}
    refused = script("pareto", "run=runs/e", "galerkin.rank=5", cwd=tmp_path)
    assert refused.status == 2
    assert "galerkin: rank = 5 must lie between 1 and 4, " in refused.err

"""Laws of run time against error: iterates are clocked, meshes tend to a limit, sizes grow."""

import csv
import itertools

import pytest
import torch

from dpl import tradeoff
from dpl.fem.solution import solve
from dpl.hybrid import Direct, Hybrid
from dpl.rows import write
from dpl.scene import Sample


@pytest.fixture(scope="module")
def batch(scene):
    """Six loads with the truth."""
    load = scene.loads.sample((0, 9), range(6))
    return Sample(load.force, solve(scene.solver, load).displacement, load.young)


@pytest.fixture(scope="module")
def solvers(scene):
    """A network that is a thousandth off, alone and corrected, and Newton."""
    near = lambda load: 1.001 * solve(scene.solver, load).displacement  # noqa: E731
    return {
        "linear": scene.linear,
        "Newton to 1e-08": scene.solver,
        "near": Direct(near, scene.problem),
        "near, hybrid": Hybrid(near, scene.corrector),
    }


@pytest.fixture(scope="module")
def rows(solvers, batch):
    return tradeoff.points(solvers, batch)


def test_every_iterate_has_a_row_and_time_goes_on(rows, solvers):
    for name in solvers:
        path = [row for row in rows if row.solver == name]
        assert [row.iterate for row in path] == list(range(len(path)))
        assert [row.last for row in path] == [False] * (len(path) - 1) + [True]
        assert all(a.ms <= b.ms for a, b in itertools.pairwise(path))
        assert all(row.ms <= row.ms_p99 for row in path)


def test_errors_are_those_of_the_iterates(rows):
    by = {(row.solver, row.iterate): row for row in rows}
    assert by["Newton to 1e-08", 0].error == pytest.approx(1.0)
    assert by["Newton to 1e-08", 1].error == pytest.approx(by["linear", 0].error, rel=1e-6)
    assert by["near", 0].error == pytest.approx(1e-3)
    ends = {row.solver: row for row in rows if row.last}
    assert ends["Newton to 1e-08"].error < 1e-10
    assert ends["near, hybrid"].worst < 1e-6
    assert ends["near, hybrid"].residual < 1e-8
    assert ends["near, hybrid"].iterate < ends["Newton to 1e-08"].iterate


def test_threads_are_set_and_given_back(solvers, batch):
    before = torch.get_num_threads()
    seen = []

    class Spy:
        def iterate(self, load):
            seen.append(torch.get_num_threads())
            return solvers["near"].iterate(load)

    (row,) = tradeoff.points({"spy": Spy()}, batch, threads=2)
    assert set(seen) == {2}
    assert row.threads == 2
    assert torch.get_num_threads() == before


def test_values_on_meshes_twice_as_fine_tend_to_the_limit():
    values = [3.0 + 0.5 * 4.0**-k for k in range(3)]
    assert tradeoff.limit(*values) == pytest.approx(3.0, rel=1e-12)


def test_finer_meshes_are_nearer_to_the_limit_and_quadratic_ones_nearer_still():
    """The tips are those of the verification dossier, 1.8e: Saint Venant-Kirchhoff, q = 20 Pa."""
    meshes = tradeoff.discretisations(linear=((4, 1, 1), (8, 2, 2), (16, 4, 4)), repeats=1)
    tips = [mesh.tip for mesh in meshes]
    known = [-18.7537, -24.79226, -27.28787, -27.72827, -28.2134, -28.3413]
    assert tips == pytest.approx(known, abs=5e-5)
    linear, quadratic = meshes[:3], meshes[3:]
    for family in (linear, quadratic):
        assert all(a.error > b.error for a, b in itertools.pairwise(family))
    assert all(a.dofs == b.dofs for a, b in zip(linear[1:], quadratic, strict=False))
    assert all(a.error > b.error for a, b in zip(linear[1:], quadratic, strict=False))
    assert quadratic[-1].error == pytest.approx(1 - 28.3413 / 28.387, rel=0.02)


@pytest.mark.slow
def test_each_size_is_measured_in_a_process_of_its_own(tmp_path):
    rows = [row for part in tradeoff.sizes([2, 3], loads=2) for row in part]
    assert sorted({row.dofs for row in rows}) == [3 * 9 * 9, 3 * 13 * 16]
    whole = [row for row in rows if row.what.startswith("fcnn")]
    assert [row.parameters for row in whole] == [4 * n**2 + 7 * n for n in (243, 624)]
    assert all(row.peak > 100 for row in rows)
    write(rows, tmp_path / "sizes.csv")
    tradeoff.draw_sizes(rows, tmp_path / "sizes.png")
    assert len(list(csv.DictReader((tmp_path / "sizes.csv").open()))) == len(rows)
    assert (tmp_path / "sizes.png").stat().st_size > 10_000


def test_exponents_are_slopes():
    rows = [tradeoff.Size("x", n, 3e-4 * n**1.5) for n in (10, 100, 1000)]
    assert tradeoff.exponent(rows) == pytest.approx(1.5)
    assert tradeoff.exponent(rows[:1]) != tradeoff.exponent(rows[:1])


def test_the_figure_and_the_rows_are_written(rows, tmp_path):
    meshes = tradeoff.discretisations(linear=((4, 1, 1),), repeats=1)
    write(rows, tmp_path / "a.csv")
    tradeoff.draw_points(rows, meshes, 0.01, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000
    written = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert [row["solver"] for row in written] == [row.solver for row in rows]


def test_the_script_measures_the_runs_of_a_folder(script, tiny_training, tmp_path, monkeypatch):
    ended = script("train", *tiny_training, "trainer.max_epochs=1", "run=runs/e/a", cwd=tmp_path)
    assert ended.status == 0, ended.err[-2000:]
    meshes = tradeoff.discretisations(linear=((4, 1, 1), (39, 9, 9)), repeats=1)
    monkeypatch.setattr(tradeoff, "discretisations", lambda repeats: meshes)
    few = ["parts=[accuracy]", "run=runs/e", "galerkin.rank=3", "repeats=1"]
    ended = script("benchmark", *few, cwd=tmp_path)
    assert ended.status == 0, ended.err[-2000:]
    folder = tmp_path / "runs" / "benchmark"
    assert (folder / "accuracy_e.png").is_file()
    written = list(csv.DictReader((folder / "accuracy_e.csv").open()))
    assert {row["solver"] for row in written} >= {"linear", "POD-Galerkin", "a", "a, hybrid"}
    refused = script("benchmark", "parts=[accuracy]", "run=runs/none", cwd=tmp_path)
    assert refused.status == 2
    assert "holds no runs" in refused.err

"""Laws of the comparison of networks on other families of loads."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import transfer
from dpl import Sample
from dpl.fem import solve


@pytest.fixture(scope="module")
def tests_of(scene):
    """Loads of two families: those of the scene, and the same at a tenth of their size."""
    load = scene.loads.sample((0, 9), range(4))
    sets = {}
    for name, factor in {"modal": 1.0, "small": 0.1}.items():
        force = factor * load.force
        solution = solve(scene.solver, load._replace(force=force))
        sets[name] = Sample(force, solution.displacement, load.young, load.parameters)
    return sets


def test_a_row_has_the_errors_of_predictions_and_the_solves_from_them(scene, tests_of):
    def predict(load):
        return 1.01 * solve(scene.solver, load).displacement

    newton = {name: transfer.newton_iterations(scene, test) for name, test in tests_of.items()}
    rows = list(transfer.measure("near", "modal", predict, scene, tests_of, newton))
    assert [(row.network, row.trained_on, row.tested_on) for row in rows] == [
        ("near", "modal", "modal"),
        ("near", "modal", "small"),
    ]
    for row in rows:
        assert row.count == 4
        assert row.rel_L2_median == pytest.approx(0.01, rel=1e-4)
        assert row.rel_L2_worst == pytest.approx(0.01, rel=1e-4)
        assert pytest.approx(40.0864, abs=1e-2) == row.SNR_min
        assert row.converged == 100
    assert rows[0].newton_iterations > rows[1].newton_iterations, "small loads are nearly linear"


def test_the_file_of_fingertips_is_what_its_program_writes(tmp_path, monkeypatch):
    folder, copy = Path(transfer.__file__).parent / "loads", tmp_path / "forces.npz"
    monkeypatch.setattr(sys, "argv", ["fingertips", str(copy)])
    runpy.run_path(str(folder / "fingertips.py"), run_name="__main__")
    forces, stored = (np.load(path)["forces"] for path in (copy, folder / "fingertips.npz"))
    np.testing.assert_allclose(forces, stored, rtol=1e-5)
    assert forces.shape == (32, 4000, 3)
    assert forces.any(axis=(1, 2)).all()


def test_scenes_of_another_body_are_named(scene, make_scene):
    assert transfer.differences({"a": scene, "b": scene}) == []
    lines = transfer.differences({"a": scene, "b": make_scene(cell="tetra")})
    assert lines
    assert all(line.startswith("b and a: ") for line in lines)


def test_a_matrix_is_drawn_for_each_network(tmp_path):
    pairs = [("modal", "modal"), ("modal", "point"), ("point", "point")]  # one is missing
    rows = [
        transfer.Transfer(net, a, b, 3, 10.0**-k, 0.1, 20.0, 100.0, 3.0, 4.0)
        for net in ("unrolled", "fcnn")
        for k, (a, b) in enumerate(pairs, 1)
    ]
    transfer.draw(rows, tmp_path / "t.png")
    one = Image.open(tmp_path / "t.png").size
    transfer.draw(rows[:3], tmp_path / "t.png")
    assert Image.open(tmp_path / "t.png").size[0] < one[0]

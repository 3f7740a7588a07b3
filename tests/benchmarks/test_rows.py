"""Rows of the studies: their loads are what their names say, their errors those of the answers."""

import itertools
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import deflections, discretisation, local_loads, peers, transfer
from benchmarks import sizes as beams
from benchmarks.samples import solved
from benchmarks.study import METHOD_COLOURS, OTHER_COLOURS, method_colours
from dpl.fem import NeoHookeanLn, SaintVenantKirchhoff, solve
from dpl.models import Unrolled
from dpl.training import MSE, Surrogate


@pytest.fixture(scope="module")
def rows(scene):
    return deflections.deflections({"a": scene, "b": scene}, 4, 0)


def test_deflections_are_those_of_the_test_loads_of_a_data_set(rows, data):
    truth = data.samples("test").displacement.norm(dim=2).amax(dim=1)
    for body in ("a", "b"):
        mine = [row for row in rows if row.body == body]
        assert [row.load for row in mine] == [0, 1, 2, 3]
        assert [row.deflection for row in mine] == pytest.approx(truth.tolist(), rel=1e-6)
    assert [len(values) for values in deflections.by_body(rows).values()] == [4, 4]


@pytest.mark.parametrize(
    ("experiment", "build"),
    [
        ("beam_svk", lambda: peers.beam_scene(SaintVenantKirchhoff(0.3))),
        ("propeller_nh", peers.propeller_scene),
    ],
)
def test_bodies_are_those_of_the_experiments(scene_of, experiment, build):
    theirs, ours = scene_of(f"experiment={experiment}"), build()
    loads = [scene.loads.sample((0, 2), range(2)).force for scene in (theirs, ours)]
    assert theirs.problem.length == ours.problem.length
    assert torch.allclose(*loads, rtol=1e-9, atol=1e-12 * float(loads[0].abs().max()))


@pytest.fixture(scope="module")
def surrogate(scene):
    samples = solved(scene, scene.loads.sample(0, range(20)))
    net = Unrolled(scene, rank=20, cells=8, stages=1)
    net.fit(samples, samples)
    return Surrogate(net, MSE(), scene).eval()


def test_point_forces_act_on_one_node_and_patches_on_few(scene):
    kinds = list(local_loads.kinds(scene, 5))
    assert [name for name, *_ in kinds] == [local_loads.RUN, *2 * list(local_loads.FAMILIES)]
    for name, _, load in kinds[1:]:
        nodes = load.force.any(dim=2).sum(dim=1)
        assert (nodes == 1).all() if name == "point force" else (nodes <= 9).all()


def test_the_rows_have_the_errors_of_the_surrogate(surrogate):
    rows = list(local_loads.measure(surrogate, 4))
    assert all(row.count == 4 for row in rows)
    assert all(0 < row.linear_p50 <= row.linear_p99 < 1e-5 for row in rows)
    scene = surrogate.scene
    load = scene.loads.sample(local_loads.STREAM, range(4))
    exact = solve(scene.newton, load).displacement
    with torch.no_grad():
        wrong = (surrogate.predict(load) - exact).flatten(1).norm(dim=1)
        errors = wrong / exact.flatten(1).norm(dim=1)
    assert rows[0].error_p50 == pytest.approx(float(errors.quantile(0.5)), rel=1e-4)
    small = [row for row in rows if row.deflection == min(local_loads.DEFLECTIONS)]
    assert all(row.error_p99 < 1e-2 for row in small)


@pytest.fixture(scope="module")
def tests_of(scene):
    """Loads of two families: those of the scene, and the same at a tenth of their size."""
    load = scene.loads.sample((0, 9), range(4))
    small = load._replace(force=0.1 * load.force)
    return {"modal": solved(scene, load), "small": solved(scene, small)}


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


def test_values_on_meshes_twice_as_fine_tend_to_the_limit():
    values = [3.0 + 0.5 * 4.0**-k for k in range(3)]
    assert discretisation.limit(*values) == pytest.approx(3.0, rel=1e-12)


def test_finer_meshes_are_nearer_to_the_limit_and_quadratic_ones_nearer_still():
    """The deflections are those of an independent code: Saint Venant-Kirchhoff, q = 20 Pa."""
    family = replace(discretisation.FAMILIES["beam"], linear=((4, 1, 1), (8, 2, 2), (16, 4, 4)))
    rows = discretisation.discretisations(family, SaintVenantKirchhoff(0.3), repeats=1)
    tips = [mesh.value for mesh in rows]
    known = [-18.7537, -24.79226, -27.28787, -27.72827, -28.2134, -28.3413]
    assert tips == pytest.approx(known, abs=5e-5)
    linear, quadratic = rows[:3], rows[3:]
    for each in (linear, quadratic):
        assert all(a.error > b.error for a, b in itertools.pairwise(each))
    assert all(a.dofs == b.dofs for a, b in zip(linear[1:], quadratic, strict=False))
    assert all(a.error > b.error for a, b in zip(linear[1:], quadratic, strict=False))
    assert quadratic[-1].error == pytest.approx(1 - 28.3413 / 28.387, rel=0.02)


def test_where_there_is_no_limit_the_finest_quadratic_mesh_stands_for_it():
    few = ((1, 1, 1, 2, 4), (1, 1, 1, 3, 8))
    family = replace(discretisation.FAMILIES["propeller"], linear=few, quadratic=few)
    rows = discretisation.discretisations(family, NeoHookeanLn(0.3), repeats=1)
    assert [(mesh.cells, mesh.degree) for mesh in rows] == [(few[0], 1), (few[1], 1), (few[0], 2)]
    assert rows[0].error > rows[1].error > rows[2].error > 0
    assert rows[2].value == pytest.approx(5.1e-3, rel=0.1)  # the blades bend, tips by 0.05 L


@pytest.mark.slow
def test_each_size_is_measured_in_a_process_of_its_own():
    rows = [row for part in beams.sizes([2, 3], loads=2) for row in part]
    assert sorted({row.dofs for row in rows}) == [3 * 9 * 9, 3 * 13 * 16]
    whole = [row for row in rows if row.case.startswith("fcnn")]
    assert [row.parameters for row in whole] == [4 * n**2 + 7 * n for n in (243, 624)]
    assert all(row.peak_memory_mb > 100 for row in rows)


def test_variants_of_a_method_have_its_colour_and_others_have_colours_of_their_own():
    names = ["fcnn", "fcnn_plain", "pod, hybrid", "Newton to 1e-06", "paper, mse", "mine", "other"]
    found = method_colours(names)
    assert found["fcnn"] == found["fcnn_plain"] == METHOD_COLOURS["fcnn"]
    assert found["pod, hybrid"] == METHOD_COLOURS["pod"]
    assert found["Newton to 1e-06"] == METHOD_COLOURS["Newton"]
    assert found["paper, mse"] == METHOD_COLOURS["paper"]
    assert found["mine"] not in METHOD_COLOURS.values()
    assert len(set(found.values())) == 6
    every = [*METHOD_COLOURS.values(), *OTHER_COLOURS]
    assert len(set(every)) == len(every)

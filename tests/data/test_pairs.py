"""Training data of another solver: files of forces and displacements."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

import dpl.fem as fem
from dpl.data import PairData, Pairs
from dpl.fem.mesh.writing import write_mesh
from dpl.scene import Scene

COUNT, YOUNG, LENGTH = 12, 4500.0, 0.5


@pytest.fixture(scope="module")
def scene():
    mesh = fem.box(size=(LENGTH, 0.2, 0.2), nodes=(5, 3, 3))
    problem = fem.Problem.build(mesh, fem.NeoHookeanLn(poisson=0.3), fixed=fem.Plane(0, 0.0))
    solver = fem.Newton(problem, 1e-9)
    loads = fem.ModalLoads(solver.linear_solver, n_modes=3, young=YOUNG)
    return Scene(problem, loads, solver)


@pytest.fixture(scope="module")
def solved(scene):
    """Forces [N] and displacements [m] that the reference solver computes."""
    load = scene.loads.sample(0, range(COUNT))
    u = torch.cat([fem.solve(scene.solver, one).displacement for one in load.unbatch()])
    return scene.si_inputs(load)["force"].numpy(), (scene.length * u).numpy()


def arrays(kind, folder, scene, force, displacement):
    """Writes pairs in millimetres and kilonewtons, the nodes in another order."""
    order = np.random.default_rng(0).permutation(scene.problem.shape[0])
    fields = {
        "points": 1e3 * scene.length * scene.problem.points.numpy()[order],
        "RF": 1e-3 * force[:, order],
        "U": 1e3 * displacement[:, order],
    }
    if kind == "npz":
        np.savez(folder / "pairs.npz", **fields)
    else:
        save_file(
            {k: np.ascontiguousarray(v) for k, v in fields.items()}, folder / "pairs.safetensors"
        )
    return folder / f"pairs.{kind}"


def vtk(kind, folder, scene, force, displacement):
    """Writes a VTK file of each pair in millimetres and kilonewtons."""
    (folder / "files").mkdir()
    mesh = scene.problem.mesh_in_metres.scaled(1e3)
    for k, (f, u) in enumerate(zip(force, displacement, strict=True)):
        write_mesh(folder / "files" / f"{k:03d}.vtu", mesh, {"RF": 1e-3 * f, "U": 1e3 * u})
    return folder / "files"


@pytest.mark.parametrize(
    ("kind", "write"), [("npz", arrays), ("safetensors", arrays), ("vtu", vtk)]
)
def test_pairs_of_files_are_samples_of_the_scene(kind, write, scene, solved, tmp_path):
    path = write(kind, tmp_path, scene, *solved)
    options = {"force": "RF", "displacement": "U", "force_unit": 1e3, "length_unit": 1e-3}
    data = PairData(scene, path=str(path), val=3, test=4, **options)
    parts = [data.samples(split) for split in ("train", "val", "test")]
    assert [len(part.force) for part in parts] == [5, 3, 4]
    found = torch.cat([part.displacement for part in parts])
    given = torch.from_numpy(solved[1]) / scene.length
    distance = torch.cdist(found.flatten(1), given.flatten(1)).min(dim=1)
    assert sorted(distance.indices.tolist()) == list(range(COUNT))
    assert distance.values.max() < 1e-6
    again = PairData(scene, path=str(path), val=3, test=4, **options).samples("test")
    assert torch.equal(again.force, parts[2].force)


@pytest.mark.parametrize("law", [fem.NeoHookeanLn, fem.UnknownLaw])
def test_constants_of_the_law_are_found_from_pairs(law, scene, solved, tmp_path):
    """Of an unknown law from small loads, whose displacements are linear."""
    force, u = solved
    if law is fem.UnknownLaw:
        linear = [scene.linear.solve(one) for one in scene.loads.sample(0, range(COUNT)).force]
        u = scene.length * torch.stack(linear).numpy()
    path = tmp_path / "pairs.npz"
    np.savez(path, force=force, displacement=u)
    body = replace(scene.problem, material=law(poisson=0.42))
    solver = fem.Newton(body, 1e-9)
    other = Scene(body, fem.FileLoads(solver.linear_solver, path, young=9000.0), solver)
    pairs = Pairs(other, path)
    assert pairs.constants == "young=4500 material.poisson=0.3"
    assert pairs.fitted_misfits.max() < 1e-3 < pairs.misfits.min()


BAD = {
    "none.npz": ({}, "No such file"),
    "one.npz": ({"force": 1}, "must contain the arrays force, displacement"),
    "names.npz": ({"force": 1, "U": 1}, "must contain an array 'displacement' and has 2: force, U"),
    "counts.npz": ({"force": 1, "displacement": slice(0, 3)}, "12 forces and 3 displacements"),
    "nan.npz": ({"force": np.nan, "displacement": 1}, "must be finite"),
    "double.npz": (
        {"force": 2, "displacement": 1},
        "young=9000 material.poisson=.* fit the smallest pairs",
    ),
    "moves.npz": ({"force": 1, "displacement": "moved"}, "supports move in 12 pairs"),
    "far.npz": ({"force": 1, "displacement": 1, "points": 3}, "has no point at .* nodes"),
    "folder": ({"vtu": 3.0}, "000.vtu: has no point at"),
    "empty": ({"vtu": 0}, "must contain files .vtu"),
}


@pytest.mark.parametrize("name", BAD)
def test_pairs_that_do_not_belong_to_the_scene_are_refused_in_one_line(
    name, scene, solved, tmp_path
):
    change, message = BAD[name]
    path = tmp_path / name
    places = scene.length * scene.problem.points.numpy()
    given = {"force": solved[0], "displacement": solved[1], "U": solved[1], "points": places}
    if "vtu" in change:
        path.mkdir()
        if change["vtu"]:
            mesh = scene.problem.mesh_in_metres.scaled(change["vtu"])
            write_mesh(path / "000.vtu", mesh, {"force": places, "displacement": places})
    elif change:
        moved = {key: _changed(given[key], how) for key, how in change.items()}
        np.savez(path, **moved)
    with pytest.raises(ValueError, match=message) as caught:
        PairData(scene, path=str(path), val=3, test=4)
    assert str(caught.value).startswith(f"path = {path}: ")
    assert "\n" not in str(caught.value)


def _changed(array, how):
    if isinstance(how, slice):
        return array[how]
    return array + 0.01 if how == "moved" else array * how

"""Laws of runs that name files: a run holds copies of them, and answers wherever it is taken."""

import json
import shutil
import struct

import meshio
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

import dpl
from benchmarks.stress.broken_meshes import write
from dpl import Scene
from dpl.config import ConfigError, run_folder
from dpl.fem import box, read_mesh, write_mesh_exactly

FILES = [  # key, origin, copy in the run, remedy where that is missing
    ("mesh.path", "part.vtu", "mesh.vtu", "write it there by dpl.fem.write_mesh_exactly, or"),
    ("material.young.file", "cells.vtu", "material.young.file.vtu", "copy it there, or"),
    ("loads.path", "forces.npy", "loads.path.npy", "copy it there, or"),
]


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    """A beam of tetrahedra in a file, a quarter of its cells inside out, with a node of no cell."""
    beam = box([100.0, 25.0, 25.0], [5, 3, 3], "tetra")
    cells = beam.t.T.copy()
    corners = beam.p.T[cells]
    left = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    cells[left] = cells[left][:, [1, 0, 2, 3]]
    cells[::4] = cells[::4][:, [1, 0, 2, 3]]
    path = tmp_path_factory.mktemp("drawings") / "part.vtu"
    return write(path, np.concatenate([beam.p.T, [[0, 0, 1e3]]]), tetra=cells)


@pytest.fixture(scope="module")
def overrides(tiny_training):
    """Overrides of a short training on a mesh file, with a field and forces of other files."""
    kept = [o for o in tiny_training if not o.startswith(("mesh.", "loads."))]
    quiet = "callbacks.progress_bar._target_=lightning.pytorch.callbacks.TQDMProgressBar"
    field = "+material.young={_target_:dpl.fem.CellField,values:stiffness,file:cells.vtu}"
    forces = ["loads=file", "loads.path=forces.npy", "loads.factor=null"]
    return [*kept, quiet, "mesh=file", field, *forces, "trainer.max_epochs=1"]


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A folder, and what the command said that trained in it: nothing yet."""
    return tmp_path_factory.mktemp("done"), {}


@pytest.fixture
def trained(part, overrides, script, done, tmp_path, in_process):
    """A run on a copy of the file, in a folder that may be harmed, and what the command said."""
    origin, said = done
    options = [*overrides, "mesh.path=part.vtu", f"data.folder={origin}/data", "run=runs/part"]
    if not said:
        (origin / "home").mkdir()
        shutil.copy(part, origin / "home" / "part.vtu")
        mesh, random = meshio.read(part), np.random.default_rng(0)
        mesh.cell_data = {"stiffness": [random.uniform(1, 2, len(mesh.cells[0].data))]}
        mesh.write(origin / "home" / "cells.vtu")
        np.save(origin / "home" / "forces.npy", random.standard_normal((3, 45, 3)))
        said["ended"] = script("train", *options, cwd=origin / "home")
        assert said["ended"].status == 0, said["ended"].err
    return shutil.copytree(origin / "home", tmp_path / "home"), options, said["ended"]


@pytest.fixture
def moved(trained, tmp_path):
    """The run elsewhere, its mesh file and its folder gone."""
    home, _, _ = trained
    there = tmp_path / "elsewhere"
    shutil.move(home / "runs" / "part", there / "runs" / "part")
    shutil.rmtree(home)
    return there


def test_a_run_on_a_mesh_file_says_what_it_is_and_what_was_corrected(trained):
    _, _, ended = trained
    lines = ended.err.splitlines()
    assert [line for line in lines if line.startswith("warning: ") and "part.vtu" in line] == [
        "warning: part.vtu: 24 of 96 cells are inverted; their nodes are reordered; "
        "1 nodes belong to no cell; they are dropped"
    ]
    size = "body      100 x 25 x 25 m, 45 nodes, 96 tetrahedra, 135 degrees of freedom"
    assert ended.out.splitlines().count(size) == 1
    assert ended.out.index(size) < ended.out.index("skipped   ")


def test_a_run_answers_the_same_where_its_mesh_file_is_not(trained, tmp_path, monkeypatch):
    home, _, _ = trained
    _, before = run_folder.load_run(home / "runs" / "part")
    load_ = before.scene.loads.sample((0, 2), range(2))
    there = tmp_path / "there"
    shutil.move(home / "runs" / "part", there)
    shutil.rmtree(home)
    monkeypatch.chdir(tmp_path)
    cfg, after = run_folder.load_run(there)
    assert (cfg.mesh.path, cfg.material.young.file) == ("part.vtu", "cells.vtu")
    assert after.scene.fingerprint == before.scene.fingerprint
    assert torch.equal(after.scene.problem.points, before.scene.problem.points)
    with torch.no_grad():
        assert torch.equal(after.predict(load_), before.predict(load_))
    scene = after.scene
    force = scene.force_unit * 4500.0 * load_.force[0]
    assert dpl.load("there")(force, tol=1e-6).converged


def test_commands_take_a_run_whose_mesh_file_is_gone(moved, script):
    for name, arguments in {
        "evaluate": ["run=runs/part"],
        "compare": ["run=runs"],
        "export": ["run=runs/part", "count=1", "outputs=[results]"],
    }.items():
        ended = script(name, *arguments, cwd=moved)
        assert ended.status == 0, (name, ended.err)


def test_a_run_whose_files_are_gone_is_resumed(trained, script):
    origin, options, _ = trained
    home = shutil.move(origin, origin.parent / "there")
    folder = home / "runs" / "part"
    before = {name: (folder / name).read_bytes() for _, _, name, _ in FILES}
    scene = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["scene"]
    for _, name, _, _ in FILES:
        (home / name).unlink()
    more = [o for o in options if "max_epochs" not in o]
    another = [o.replace("part.vtu", "other.vtu") for o in more]
    other = script("train", *another, "ckpt_path=last", cwd=home)
    assert other.status == 2
    assert "mesh.path was part.vtu, is other.vtu" in other.err
    ended = script("train", *more, "trainer.max_epochs=2", "ckpt_path=last", cwd=home)
    assert ended.status == 0, ended.err
    assert {name: (folder / name).read_bytes() for name in before} == before
    last = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    assert (last["epoch"], last["scene"]) == (1, scene)
    # another run that goes on from this one's checkpoint holds the files as well
    checkpoint = "ckpt_path=runs/part/checkpoints/last.ckpt"
    more = [o for o in more if not o.startswith("run=")]
    ended = script("train", *more, "run=runs/b", checkpoint, "trainer.max_epochs=3", cwd=home)
    assert ended.status == 0, ended.err
    assert np.array_equal(
        read_mesh(home / "runs/b/mesh.vtu").t, read_mesh(home / "runs/part/mesh.vtu").t
    )
    other = torch.load(home / "runs/b/checkpoints/last.ckpt", weights_only=True)
    assert (other["epoch"], other["scene"]) == (2, scene)


@pytest.mark.parametrize(("key", "origin", "name", "remedy"), FILES)
def test_a_run_reads_no_file_outside_of_its_folder(trained, monkeypatch, key, origin, name, remedy):
    home, _, _ = trained
    monkeypatch.chdir(home)
    copy = home / "runs" / "part" / name
    reported = rf"{key} = {origin} must be kept in the run's folder as \S+{name}; {remedy}"
    copy.unlink()
    with pytest.raises(ConfigError, match=reported) as refused:
        run_folder.load_run(home / "runs" / "part")
    assert "\n" not in str(refused.value)
    copy.symlink_to(home / origin)
    with pytest.raises(ConfigError, match=reported):
        run_folder.load_run(home / "runs" / "part")
    copy.unlink()
    run_folder.load_run(home / "runs" / "part", trust=True)


# ------------------------------------------------------------------ hostile sizes


def _renamed(path, change):
    """Rewrite the header of a file of weights."""
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    reported = json.loads(header["__metadata__"]["dpl"])
    change(reported)
    header["__metadata__"]["dpl"] = json.dumps(reported)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])


@pytest.fixture(scope="module")
def boxed(tiny_training, tmp_path_factory):
    """A folder in which a run on a box is trained, or was."""
    return tmp_path_factory.mktemp("boxed")


@pytest.fixture
def handed_on(boxed, tiny_training, script, tmp_path):
    """A run on a box of 45 nodes, in a folder that may be harmed."""
    if not (boxed / "runs" / "box").exists():
        quiet = "callbacks.progress_bar._target_=lightning.pytorch.callbacks.TQDMProgressBar"
        options = [*tiny_training, quiet, "trainer.max_epochs=1", "run=runs/box"]
        assert script("train", *options, cwd=boxed).status == 0
    return shutil.copytree(boxed / "runs" / "box", tmp_path / "run")


MESHES = [  # a mesh, and what the header of the weights tells of its nodes
    ({"_target_": "dpl.fem.box", "size": [100, 25, 25], "nodes": [6, 3, 3]}, lambda told: None),
    (
        {"_target_": "dpl.fem.box", "size": [1, 1, 1], "nodes": [200, 200, 200]},
        lambda told: told.pop("nodes"),
    ),
    (
        {"_target_": "dpl.fem.rectangle", "size": [1, 1], "nodes": [2000, 2000]},
        lambda told: told.update(nodes=10**9),
    ),
    ({"_target_": "dpl.fem.propeller", "cells": [90, 90, 90, 90, 90]}, lambda told: None),
]


@pytest.mark.parametrize(("mesh", "lie"), MESHES)
def test_a_mesh_of_more_nodes_than_the_weights_have_is_refused_before_it_is_made(
    handed_on, mesh, lie, monkeypatch
):
    """Where the header lies too, a body has no more nodes than the weights have numbers."""
    cfg = OmegaConf.load(handed_on / "config.yaml")
    cfg.mesh = mesh
    (handed_on / "config.yaml").write_text(OmegaConf.to_yaml(cfg))
    _renamed(handed_on / "checkpoints" / "best.safetensors", lie)

    def forbidden(*_, **__):
        raise AssertionError("made")

    monkeypatch.setattr(np, "linspace", forbidden)
    monkeypatch.setattr(Scene, "__init__", forbidden)
    with pytest.raises(
        ConfigError, match=r"^mesh: mesh\.\w+ = .* nodes must be .* at most; .*best"
    ) as reported:
        run_folder.load_run(handed_on)
    assert "\n" not in str(reported.value)


def test_a_larger_mesh_file_in_the_folder_is_refused_by_its_nodes(handed_on, part):
    cfg = OmegaConf.load(handed_on / "config.yaml")
    cfg.mesh = {"_target_": "dpl.fem.read_mesh", "path": "x"}
    (handed_on / "config.yaml").write_text(OmegaConf.to_yaml(cfg))
    write_mesh_exactly(handed_on / "mesh.vtu", box([100.0, 25.0, 25.0], [6, 3, 3]))
    with pytest.raises(ConfigError, match=r"mesh: .*mesh\.vtu: its size = 54 nodes must be 45"):
        run_folder.load_run(handed_on)


def test_a_trusted_run_may_have_any_mesh_that_its_weights_fit(handed_on):
    scenes = [run_folder.load_run(handed_on, trust=trust)[1].scene for trust in (False, True)]
    assert scenes[0].problem.shape[0] == 45
    assert scenes[0].fingerprint == scenes[1].fingerprint

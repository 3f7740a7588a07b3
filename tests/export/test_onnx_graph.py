"""Graphs of all networks against torch, and what cannot be one."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from dpl import Sample
from dpl.export import check, compare, export, read_meta, read_reference, verify, write
from dpl.export import onnx_graph as graphs
from dpl.export.check import distance, trial
from dpl.export.folder import described, read_raw, reference
from dpl.export.onnx_graph import Graph, Session
from dpl.fem import Load, rectangle, solve, surface
from dpl.fem.postprocess import triangles
from dpl.models import CNN, FCNN, GNN, Latent, PODNet
from dpl.training import MSE, Surrogate

pytestmark = pytest.mark.skipif(
    bool(graphs.missing()), reason=f"{', '.join(graphs.missing())} not installed (extra onnx)"
)
CONSUMERS = Path(__file__).parents[2] / "docs" / "consumers"


def built(make, scene, seed=0, **options):
    """Return a surrogate of random weights; with bases of a few solved loads if it has some."""
    torch.manual_seed(seed)
    surrogate = Surrogate(make(scene, **options), MSE(), scene)
    if isinstance(surrogate.net, PODNet):
        load = scene.loads.sample((0, 1), range(8))
        truth = solve(scene.solver, load).displacement
        surrogate.fit_bases(Sample(load.force, truth, load.young, load.poisson))
    return surrogate.eval()


NETWORKS = {
    "fcnn": (FCNN, {"width": 16}, {}),
    "fcnn, whole, young": (
        FCNN,
        {"width": 16, "all_dofs": True, "young": True},
        {"young": [1e3, 9e3]},
    ),
    "fcnn, poisson": (FCNN, {"width": 16}, {"poisson": [0.2, 0.4]}),
    "cnn": (CNN, {"channels": 4}, {}),
    "cnn, immersed": (CNN, {"channels": 4, "grid": 7}, {"young": [1e9, 2e11]}),
    "cnn, poisson, 2D": (CNN, {"channels": 4}, {"poisson": [0.2, 0.4], "mesh": "strip"}),
    "gnn": (GNN, {"width": 8}, {}),
    "gnn, edges": (GNN, {"width": 8, "levels": 1}, {"nodes": (9, 3, 3)}),
    "gnn, poisson": (GNN, {"width": 8}, {"poisson": [0.2, 0.4]}),
    "pod": (PODNet, {"rank": 8, "width": 16}, {}),
    "latent": (Latent, {"rank": 16, "width": 16, "linear_tol": 0.01}, {}),
    "latent, quadratic": (Latent, {"rank": 8, "width": 16}, {"nodes": (3, 2, 2), "degree": 2}),
    "latent, poisson": (Latent, {"rank": 8, "width": 16}, {"poisson": [0.2, 0.4]}),
    "latent, no factor": (Latent, {"rank": 8, "width": 16, "linear_tol": float("inf")}, {}),
}


RARE = {"fcnn, poisson", "cnn, immersed", "gnn, poisson", "latent, no factor"}
EVERY = [pytest.param(one, marks=pytest.mark.slow) if one in RARE else one for one in NETWORKS]


@pytest.fixture(scope="module")
def made(make_scene, tmp_path_factory):
    """Surrogates with their graphs, each made once."""
    kept = {}

    def made(name):
        if name not in kept:
            make, options, scene = NETWORKS[name]
            scene = {
                key: rectangle([100.0, 25.0], [9, 3]) if value == "strip" else value
                for key, value in scene.items()
            }
            graph = Graph(built(make, make_scene(**scene), **options))
            path = tmp_path_factory.mktemp("graph") / "model.onnx"
            export(graph, path)
            kept[name] = graph, path
        return kept[name]

    return made


@pytest.mark.parametrize("name", EVERY)
def test_a_graph_answers_as_torch_does_whatever_the_load_and_the_batch(made, name):
    graph, path = made(name)
    rows = compare(graph, Session(path), trial(graph.surrogate.scene, 8))
    assert [row.kind for row in rows][:2] == ["in range", "small"]
    assert sum(row.loads for row in rows) == 8 + 6 * check.FEW
    assert max(row.error for row in rows) < 1e-5


def test_only_latent_has_a_second_output(made):
    for name in ("fcnn", "pod", "latent", "latent, no factor"):
        session = Session(made(name)[1])
        assert ("local" in session.outputs) == (name == "latent")


def test_local_loads_are_flagged_and_answered_within_the_basis(made):
    graph, path = made("latent")
    tried = trial(graph.surrogate.scene, 8)
    rows = {row.kind: row for row in compare(graph, Session(path), tried)}
    assert rows["on a node"].local > 0
    assert rows["in range"].local < rows["in range"].loads
    assert rows["on a node"].local_error > 0.005, "which the graph says it does not know"
    assert rows["zero"].local == 0
    assert rows["zero"].error == 0
    answer = Session(path)(*(column.numpy() for column in tried.part(slice(None))))
    with torch.no_grad():
        truth = graph.surrogate(tried.force, tried.young)
    near = distance(answer.displacement, truth.numpy())
    assert near[~answer.local].max() < 1e-5
    assert near[answer.local].max() == pytest.approx(
        max(r.local_error for r in rows.values() if r.local)
    )


def test_a_graph_that_is_off_is_found(made):
    graph, path = made("fcnn")
    session, scene = Session(path), graph.surrogate.scene
    first = graph.surrogate.net.stages[0].weight
    with torch.no_grad():
        first.mul_(1 + 1e-3)
        rows = compare(graph, session, trial(scene, 4))
        first.div_(1 + 1e-3)
    assert max(row.error for row in rows) > 1e-5
    assert max(row.error for row in compare(graph, session, trial(scene, 4))) < 1e-5


def test_a_flag_that_is_off_is_found(made):
    graph, path = made("latent")
    net = graph.surrogate.net
    before, net.linear_tol = net.linear_tol, 1e-12
    rows = compare(graph, Session(path), trial(graph.surrogate.scene, 4))
    net.linear_tol = before
    assert max(row.error for row in rows) == np.inf


class Looking(nn.Module):
    """A network that decides by the values of a load."""

    def __init__(self, scene):
        super().__init__()
        self.scale = nn.Parameter(torch.ones(1))

    def forward(self, force):
        return self.scale * (force if bool(force.sum() > 0) else -force)


class Counting(Looking):
    """A network that keeps the batch that it was followed with."""

    def forward(self, force):
        return self.scale * torch.cat([force[k : k + 1] for k in range(len(force))])


@pytest.mark.parametrize("make", [Looking, Counting])
def test_a_network_that_no_graph_holds_is_refused_in_words(scene, tmp_path, make):
    with pytest.raises(ValueError, match=f"{make.__name__} cannot be written as an ONNX graph: "):
        export(Graph(built(make, scene)), tmp_path / "model.onnx")
    assert not (tmp_path / "model.onnx").exists()


def test_distance_is_relative_and_nothing_is_far_from_nothing():
    zero, one = np.zeros((1, 2, 3)), np.ones((1, 2, 3))
    assert distance(zero, zero) == 0
    assert distance(one, zero) == np.inf
    assert distance(1.5 * one, one) == pytest.approx(0.5)
    assert distance(np.nan * one, one) == np.inf


# ---------------------------------------------------------------------- the folder


@pytest.fixture(scope="module")
def handed(made):
    """Folders as they are handed on, each with its graph and what was meant."""

    def handed(name):
        graph, path = made(name)
        told = reference(graph)
        meta = described(graph, path, told, tol=1e-5, errors={"e_mean": 1.0})
        write(path.parent, graph.surrogate, told, meta)
        return graph, path.parent, told, meta

    return handed


@pytest.mark.parametrize("name", ["fcnn", "latent, quadratic", "cnn, poisson, 2D"])
def test_a_folder_read_back_is_what_was_written(handed, name):
    graph, folder, told, meta = handed(name)
    verify(folder, graph.surrogate, told, meta)
    problem = graph.surrogate.scene.problem
    found = read_meta(folder)
    points = np.array(found["mesh"]["points"])
    assert np.array_equal(points, (problem.length * problem.points).numpy())
    assert len(found["mesh"]["cells"]) == len(problem.cells)
    held = np.zeros(problem.free.numel(), dtype=bool)
    held[found["dofs"]["held"]] = True
    assert np.array_equal(held.reshape(problem.shape), ~problem.free.numpy())
    assert [one["name"] for one in found["model"]["inputs"]] == Session(
        folder / "model.onnx"
    ).inputs


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("meta.json", lambda path: path.write_text(path.read_text().replace("node-major", "x"))),
        ("reference/force.f64", lambda path: path.write_bytes(bytes(path.stat().st_size))),
        ("weights.safetensors", lambda path: path.write_bytes(path.read_bytes()[:-1] + b"\x7f")),
    ],
)
def test_a_folder_that_changed_is_found(handed, file, change):
    graph, folder, told, meta = handed("fcnn")
    change(folder / file)
    with pytest.raises(ValueError, match=r"is not what was written"):
        verify(folder, graph.surrogate, told, meta)
    handed("fcnn")


def test_the_reference_is_the_surrogate_s_answer_and_that_of_finite_elements(handed):
    graph, folder, told, _ = handed("latent")
    scene, found = graph.surrogate.scene, read_reference(folder)
    assert told.converged
    assert told.exact_residual < 1e-8 < told.residual
    load = scene.load_of(torch.from_numpy(found["force"]), torch.from_numpy(found["young"]))
    exact = torch.from_numpy(found["exact"]) / scene.length
    assert float(scene.problem.relative_residual(exact, load.force)) < 1e-8
    answer = Session(folder / "model.onnx")(found["force"], found["young"])
    assert not answer.local.any()
    assert distance(answer.displacement, found["displacement"]) < 1e-5


def test_scales_and_weights_are_enough_to_answer_without_this_package(handed):
    """The fully connected network in NumPy, by what meta.json says."""
    from safetensors.numpy import load_file

    _, folder, _, _ = handed("fcnn")
    meta, found = read_meta(folder), read_reference(folder)
    weights, scales = load_file(folder / "weights.safetensors"), meta["scales"]
    unit = found["young"] * scales["force_unit"] * scales["force"]
    x = (found["force"].reshape(-1) / unit)[meta["dofs"]["acting"]].astype(np.float32)
    for k in (0, 2, 4, 6):
        x = weights[f"net.stages.{k}.weight"] @ x + weights[f"net.stages.{k}.bias"]
        if k < 6:
            x = np.where(x > 0, x, weights[f"net.stages.{k + 1}.weight"] * x)
    answer = np.zeros(meta["dofs"]["count"])
    answer[np.setdiff1d(np.arange(len(answer)), meta["dofs"]["held"])] = x
    answer *= scales["length"] * scales["displacement"]
    expected = found["displacement"].reshape(-1)
    assert np.linalg.norm(answer - expected) < 1e-5 * np.linalg.norm(expected)


def test_the_range_of_the_training_can_be_told_without_this_package(handed):
    graph, folder, _, _ = handed("fcnn")
    scene, meta = graph.surrogate.scene, read_meta(folder)
    modes = read_raw(folder / "modes.f64", meta["range"]["modes"]["shape"])
    load = scene.loads.sample((0, 13), range(6))
    load = Load(torch.cat([load.force, 3 * load.force, torch.ones_like(load.force)]), load.young)
    amplitude, strange = scene.loads.project(load.force)
    for k, force in enumerate(load.force.numpy()):
        force.reshape(-1)[meta["dofs"]["held"]] = 0.0
        acting = force.any(axis=1)
        shapes = modes[acting].reshape(-1, modes.shape[2])
        right = force[acting].reshape(-1)
        q = np.linalg.lstsq(shapes, right, rcond=None)[0]
        rest = np.linalg.norm(right - shapes @ q) / np.linalg.norm(force)
        assert abs(rest - float(strange[k])) < 1e-6
        if k < 6:
            assert abs(q).max() == pytest.approx(float(amplitude[k]), rel=1e-6)
            assert np.linalg.norm(force) <= meta["range"]["largest_force"]


@pytest.mark.parametrize("cell", ["hexahedron", "tetra", "quad", "triangle"])
def test_triangles_enclose_the_body_and_look_outwards(make_scene, cell):
    flat = cell in ("quad", "triangle")
    body = {"mesh": rectangle([100.0, 25.0], [5, 3], cell)} if flat else {"cell": cell}
    problem = make_scene(**body).problem
    corners = problem.points.numpy()[triangles(surface(problem.mesh))]
    edges = corners[:, 1:] - corners[:, :1]
    if flat:
        assert np.linalg.det(edges).sum() / 2 == pytest.approx(0.25)
        assert (np.linalg.det(edges) > 0).all()
    else:
        volume = np.linalg.det(corners).sum() / 6
        assert volume == pytest.approx(0.0625)


# ---------------------------------------------------------------------- who reads it


def spoilt(folder, tmp_path):
    """Return a copy of a folder whose reference is a percent off."""
    import shutil

    other = tmp_path / "spoilt"
    shutil.copytree(folder, other)
    path = other / "reference" / "displacement.f64"
    path.write_bytes((1.01 * np.fromfile(path, "<f8")).tobytes())
    return other


@pytest.mark.parametrize("name", ["fcnn", "cnn, poisson, 2D", "gnn", "pod", "latent"])
def test_the_consumer_in_python_repeats_the_reference(handed, tmp_path, name):
    _, folder, _, _ = handed(name)
    program = str(CONSUMERS / "consumer.py")
    for place, status in ((folder, 0), (spoilt(folder, tmp_path), 1)):
        command = [sys.executable, program, str(place)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == status, done.stderr
        assert "from the reference" in done.stdout


def test_the_consumer_in_python_needs_numpy_and_onnxruntime_alone():
    text = (CONSUMERS / "consumer.py").read_text()
    imported = {line.split()[1] for line in text.splitlines() if line.startswith("import")}
    assert imported == {"json", "sys", "numpy", "onnxruntime"}


def headers():
    """Return the folder of ONNX Runtime's headers, or None; wheels have none."""
    root = os.environ.get("ONNXRUNTIME_ROOT")
    places = [Path(root) / "include"] if root else []
    places += [Path("/usr/include/onnxruntime"), Path("/usr/local/include/onnxruntime")]
    return next((path for path in places if (path / "onnxruntime_cxx_api.h").is_file()), None)


@pytest.fixture(scope="module")
def consumer(tmp_path_factory):
    """The consumer in C++, linked against the library within the wheel."""
    import shutil

    import onnxruntime

    compiler, include = shutil.which("g++"), headers()
    (library, *_) = (
        *(Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*"),
        None,
    )
    if compiler is None:
        pytest.skip("no g++")
    if include is None:
        pytest.skip("no headers of ONNX Runtime: set ONNXRUNTIME_ROOT to where include/ is")
    if library is None:
        pytest.skip("the wheel of onnxruntime holds no libonnxruntime.so")
    folder = tmp_path_factory.mktemp("consumer")
    (folder / "libonnxruntime.so.1").symlink_to(library)
    program = folder / "consumer"
    command = [compiler, "-std=c++17", "-Wall", "-Werror", str(CONSUMERS / "consumer.cpp")]
    command += [f"-I{include}", str(folder / "libonnxruntime.so.1"), f"-Wl,-rpath,{folder}"]
    built = subprocess.run([*command, "-o", str(program)], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return program


@pytest.mark.parametrize("name", ["fcnn", "cnn, poisson, 2D", "gnn", "pod", "latent"])
def test_the_consumer_in_cpp_repeats_the_reference(consumer, handed, tmp_path, name):
    _, folder, _, _ = handed(name)
    for place, status in ((folder, 0), (spoilt(folder, tmp_path), 1)):
        done = subprocess.run(
            [str(consumer), str(place)], capture_output=True, text=True, timeout=120
        )
        assert done.returncode == status, done.stderr
        assert "from the reference" in done.stdout

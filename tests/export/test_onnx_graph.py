"""ONNX graphs of all networks against torch, exported folders, and the example consumers."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from benchmarks.samples import solved
from dpl import fem
from dpl.export import OnnxSession, compare_outputs, comparison, export_onnx, write_folder
from dpl.export.comparison import relative_differences, sample_check_loads
from dpl.export.onnx_graph import missing_packages, to_float32
from dpl.export.quantities import NUMBERS, Quantities, position
from dpl.inference.answer import RangeCheck
from dpl.models import CNN, FCNN, GNN, Inputs, PODNet, Unrolled
from dpl.training import TrainedSurrogate, checkpoints

pytestmark = pytest.mark.skipif(
    bool(missing_packages()), reason=f"{', '.join(missing_packages())} not installed (extra onnx)"
)
CONSUMERS = Path(__file__).parents[2] / "docs" / "consumers"


def make_surrogate(make, scene, *, base=None, young=False, **options):
    """Return a surrogate with random weights, and with bases fitted to a few solved loads."""
    torch.manual_seed(0)
    inputs = () if make is Unrolled else (Inputs.from_scene(scene, base, young=young),)

    def build():
        net = make(scene, *inputs, **options)
        return TrainedSurrogate(net, scene, base=base, young=young).eval()

    surrogate = build()
    if make not in (PODNet, Unrolled):
        return surrogate
    samples = solved(scene, scene.loads.sample((0, 1), range(20)))
    if make is PODNet:
        surrogate.predictor.fit_bases(samples)
        return surrogate
    surrogate.net.fit(samples, samples)
    again = build()  # as from a checkpoint: it has predicted nothing yet and lacks blocks of K(0)
    again.load_state_dict(surrogate.state_dict())
    return again


def fibres_in_a_matrix(poisson):
    """Return a law with three ranges, in which K(0) has three terms."""
    matrix = fem.NeoHookeanIsoK2([poisson, 0.4], [0.5, 2.0])
    return fem.FibreReinforced(
        matrix, fem.Guccione([0.1, 1.0], 8.0, 2.0, 4.0), fem.ConstantFibres([2, 1, 0])
    )


NETWORKS = {
    "fcnn": (FCNN, {"width": 16}, {}),
    "fcnn, young": (FCNN, {"width": 16, "young": True}, {"young": [1e3, 9e3]}),
    "fcnn, whole, young, log": (
        FCNN,
        {"width": 16, "all_dofs": True, "young": True},
        {"young": {"low": 1e3, "high": 1e8, "distribution": "log"}},
    ),
    "fcnn, poisson": (FCNN, {"width": 16}, {"poisson": [0.2, 0.4]}),
    "cnn": (CNN, {"channels": 4}, {}),
    "cnn, immersed": (CNN, {"channels": 4, "grid": 7}, {"young": [1e9, 2e11]}),
    "cnn, poisson, 2D": (CNN, {"channels": 4}, {"poisson": [0.2, 0.4], "mesh": "strip"}),
    "gnn": (GNN, {"width": 8}, {}),
    "gnn, edges": (GNN, {"width": 8, "levels": 1}, {"nodes": (9, 3, 3)}),
    "gnn, poisson": (GNN, {"width": 8}, {"poisson": [0.2, 0.4]}),
    "pod": (PODNet, {"rank": 8, "width": 16}, {}),
    "pod, linear base": (
        PODNet,
        {"rank": 8, "width": 16, "base": "linear"},
        {"nodes": (3, 2, 2), "poisson": [0.2, 0.4]},
    ),
    "unrolled": (Unrolled, {"rank": 12, "cells": 8, "stages": 1}, {}),
    "unrolled, quadratic, no symmetry": (
        Unrolled,
        {"rank": 8, "cells": 8, "stages": 1, "symmetry": False},
        {"nodes": (3, 2, 2), "degree": 2},
    ),
    "unrolled, poisson": (Unrolled, {"rank": 8, "cells": 8, "stages": 1}, {"poisson": [0.2, 0.4]}),
    "unrolled, three terms": (
        Unrolled,
        {"rank": 8, "cells": 8, "stages": 1},
        {"law": fibres_in_a_matrix, "deflection": 0.02},
    ),
}


WITH_NUMBERS = {"unrolled": NUMBERS, "unrolled, poisson": NUMBERS[:2]}
RARE = {"fcnn, young", "fcnn, poisson", "cnn", "cnn, immersed", "gnn, edges", "gnn, poisson", "pod"}
RARE |= {"unrolled, three terms", "unrolled, poisson", "unrolled, quadratic, no symmetry"}
EVERY = [pytest.param(one, marks=pytest.mark.slow) if one in RARE else one for one in NETWORKS]


@pytest.fixture(scope="module")
def make_graph(make_scene, tmp_path_factory):
    """Function that returns the surrogate of a network and its ONNX file; each is made once."""
    graphs = {}

    def make_graph(name):
        if name not in graphs:
            make, options, scene = NETWORKS[name]
            scene = {
                key: fem.rectangle([100.0, 25.0], [9, 3]) if value == "strip" else value
                for key, value in scene.items()
            }
            surrogate = make_surrogate(make, make_scene(**scene), **options)
            path = tmp_path_factory.mktemp("graph") / "model.onnx"
            export_onnx(surrogate, path, numbers=WITH_NUMBERS.get(name, ()))
            graphs[name] = surrogate, path
        return graphs[name]

    return make_graph


def test_displacements_with_inverted_elements_are_not_compared(make_graph, monkeypatch):
    surrogate, path = make_graph("fcnn")
    monkeypatch.setitem(comparison.AMPLITUDES, "large", 1e6)  # of random weights
    kinds, inputs = sample_check_loads(surrogate.scene, 2)
    own = [k for k, kind in enumerate(kinds) if kind in ("large", "in range")]
    loads = [kinds[k] for k in own], {key: column[own] for key, column in inputs.items()}
    session = OnnxSession(path)

    def wrong(**given):
        return {name: 1.1 * one for name, one in session(**given).items()}

    wrong.outputs = session.outputs
    rows = {row.kind: row.max_error for row in compare_outputs(surrogate, wrong, *loads)}
    assert rows["large"] == 0
    assert rows["in range"] == pytest.approx(0.1, rel=1e-3)


def test_a_graph_that_returns_nan_differs_everywhere(make_graph):
    surrogate, path = make_graph("fcnn")
    session = OnnxSession(path)

    def broken(**given):
        return {name: np.full_like(one, np.nan) for name, one in session(**given).items()}

    broken.outputs = session.outputs
    rows = compare_outputs(surrogate, broken, *sample_check_loads(surrogate.scene, 2))
    assert all(row.max_error == np.inf for row in rows)


@pytest.mark.parametrize("name", EVERY)
def test_onnx_and_torch_agree_for_all_kinds_of_loads_and_batch_sizes(make_graph, name):
    """Small forces on a node have their linear solution, which no basis has to represent."""
    surrogate, path = make_graph(name)
    pair, scene = (surrogate, OnnxSession(path)), surrogate.scene
    kinds, inputs = sample_check_loads(scene, 8)
    rows = compare_outputs(*pair, kinds, inputs)
    assert [row.kind for row in rows][:2] == ["in range", "small"]
    assert sum(row.n_loads for row in rows) == 8 + 6 * comparison.N_OUTSIDE
    # random weights with slopes near 1 amplify the rounding errors of whitening about threefold
    limit = 3e-5 if name == "pod, linear base" else 1e-5
    assert max(row.max_error for row in rows) < limit
    if name == "fcnn":  # another weight is detected
        first = surrogate.net.stages[0].weight
        with torch.no_grad():
            first.mul_(1 + 1e-3)
            rows = compare_outputs(*pair, *sample_check_loads(scene, 4))
            first.div_(1 + 1e-3)
        assert max(row.max_error for row in rows) > limit
    if "linear base" in name or "unrolled" in name:
        own = [k for k, kind in enumerate(kinds) if kind == "on a node"]
        small = {key: column[own] for key, column in inputs.items()}
        small["force"] = 1e-6 * small["force"]
        states = scene.linear.iterate(scene.load_of(**small))
        linear = scene.length * next(iter(states)).displacement.numpy()
        assert relative_differences(pair[1](**small)["displacement"], linear).max() < 1e-4


def in_parts(load):
    """Return loads, and the same on the first half of the nodes, on none, and 3 times as large."""
    force = load.force.clone()
    force[:, len(force[0]) // 2 :] = 0.0
    every = torch.cat([load.force, force, 0 * force, 3 * load.force])
    return fem.Load(every, load.young.repeat(4), load.parameters.repeat(4, 1))


def determined(force):
    """Return True for loads on no node or on enough nodes to determine three coefficients."""
    nodes = (force != 0).any(dim=2).sum(dim=1)
    return (nodes == 0) | (nodes > 3)


def test_numbers_are_those_of_python(make_graph):
    surrogate, path = make_graph("unrolled")
    session, scene = OnnxSession(path), surrogate.scene
    assert session.outputs == ["displacement", *NUMBERS]
    load = in_parts(scene.loads.sample((0, 12), range(4)))
    found = session(**scene.si_inputs(load))
    u = torch.from_numpy(found["displacement"]) / scene.length
    for k, single in enumerate(load.unbatch()):
        body = scene.problem.with_parameters(single.parameters)
        internal, lowest = body.evaluate(u[k : k + 1])
        residual = float(body.relative_residual_of(internal, single.force))
        assert found["residual"][k] == pytest.approx(residual, rel=1e-6)
        assert found["min_det_F"][k] == pytest.approx(float(lowest), rel=1e-12)
    many = determined(load.force)
    amplitude = scene.loads.project(load.force)[0].numpy()
    assert found["amplitude"][many] == pytest.approx(amplitude[many], rel=1e-6, abs=1e-12)
    inside = torch.tensor([place.inside for place in RangeCheck.of(surrogate, load)])
    assert inside[many].any()
    assert not inside[many].all()
    with torch.inference_mode():
        errors = surrogate.predict_with_errors(load)[1][:, 0]
    expected = torch.where(inside, errors, torch.inf).numpy()
    assert found["error"][many] == pytest.approx(expected[many], rel=1e-3)  # float32 products


def test_residuals_of_a_body_with_ranges_are_refused(make_scene):
    surrogate = make_surrogate(FCNN, make_scene(poisson=[0.2, 0.4]), width=16)
    with pytest.raises(ValueError, match=r"^numbers = residual must be evaluated without ranges"):
        Quantities(surrogate, ["error", "residual"])


def test_numbers_that_need_the_range_of_searched_loads_are_refused(make_scene):
    scene = make_scene()
    patches = replace(scene, loads=fem.PatchLoads(scene.linear))
    surrogate = make_surrogate(FCNN, patches, width=16)
    Quantities(surrogate, ["min_det_F"])
    with pytest.raises(ValueError, match=r"^numbers = error must be left out for PatchLoads"):
        Quantities(surrogate, ["min_det_F", "error"])


def test_amplitudes_are_those_of_the_family(make_scene):
    linear, end = (scene := make_scene()).linear, fem.Plane(0, "max")
    vectors = fem.FaceTractions(linear, region=end), fem.FacePressure(linear, region=end)
    for loads in (scene.loads, *vectors, fem.PointLoads(linear)):
        force = in_parts(loads.sample((0, 12), range(4))).force
        pairs, many = (
            zip(position(loads, force), loads.project(force), strict=True),
            determined(force),
        )
        for one, other in pairs:
            assert torch.allclose(one[many], other[many], rtol=1e-6, atol=1e-6, equal_nan=True)


@pytest.mark.parametrize("name", ["fcnn", "unrolled"])
def test_a_graph_in_float32_has_no_other_type(make_graph, tmp_path, name):
    """The graph of `unrolled` is converted from its file, since an export takes long."""
    import onnx
    import onnx_ir

    (surrogate, made), path = make_graph(name), tmp_path / "model.onnx"
    if name == "fcnn":
        export_onnx(surrogate, path, dtype="float32")
    else:
        to_float32(model := onnx_ir.load(str(made)))
        onnx_ir.save(model, str(path))
    graph = onnx.load(str(path)).graph
    double = onnx.TensorProto.DOUBLE
    typed = [*graph.input, *graph.output, *graph.value_info]
    assert all(one.type.tensor_type.elem_type != double for one in typed)
    assert all(one.data_type != double for one in graph.initializer)
    rows = compare_outputs(surrogate, OnnxSession(path), *sample_check_loads(surrogate.scene, 8))
    assert max(row.max_error for row in rows) < 1e-3


class ValueDependent(nn.Module):
    """Network with control flow that depends on the values of a load."""

    def __init__(self, scene, inputs):
        super().__init__()
        self.scale = nn.Parameter(torch.ones(1))

    def forward(self, force, scalars):
        return self.scale * (force if bool(force.sum() > 0) else -force)


class FixedBatch(ValueDependent):
    """Network whose graph has the batch size of the example inputs."""

    def forward(self, force, scalars):
        return self.scale * torch.cat([force[k : k + 1] for k in range(len(force))])


@pytest.mark.parametrize("make", [ValueDependent, FixedBatch])
def test_a_network_without_a_graph_for_all_loads_raises_an_error(scene, tmp_path, make):
    with pytest.raises(ValueError, match=f"{make.__name__} cannot be written as an ONNX graph: "):
        export_onnx(make_surrogate(make, scene), tmp_path / "model.onnx")
    assert not (tmp_path / "model.onnx").exists()


def test_differences_are_relative_and_zero_between_zero_fields():
    zero, one = np.zeros((1, 2, 3)), np.ones((1, 2, 3))
    assert relative_differences(zero, zero) == 0
    assert relative_differences(one, zero) == np.inf
    assert relative_differences(1.5 * one, one) == pytest.approx(0.5)
    assert relative_differences(np.nan * one, one) == np.inf


# ---------------------------------------------------------------------- the folder


@pytest.fixture(scope="module")
def write_export(make_graph):
    """Function that writes the folder of a network; returns it with surrogate and contents."""

    def write_export(name):
        surrogate, path = make_graph(name)
        folder = path.parent
        write_folder(surrogate, folder, tol=1e-5, errors={"e_mean": 1.0})
        meta = json.loads((folder / "meta.json").read_text())
        reference = {
            key: np.fromfile(folder / f"reference/{key}.f64", "<f8").reshape(shape)
            for key, shape in meta["reference"]["shapes"].items()
        }
        return surrogate, folder, meta, reference

    return write_export


@pytest.mark.parametrize("name", ["fcnn", "cnn, poisson, 2D"])
def test_a_folder_describes_its_surrogate(write_export, name):
    surrogate, folder, found, _ = write_export(name)
    assert (found["format"], found["errors"]) == (4, {"e_mean": 1.0})
    state = checkpoints.read(folder / "weights.safetensors")["state_dict"]
    own = surrogate.state_dict()
    assert state.keys() == own.keys()
    assert all(torch.equal(state[key], own[key]) for key in own)
    problem = surrogate.scene.problem
    points = np.array(found["mesh"]["points"])
    assert np.array_equal(points, (problem.length * problem.points).numpy())
    assert len(found["mesh"]["cells"]) == len(problem.cells)
    held = np.zeros(problem.free.numel(), dtype=bool)
    held[found["dofs"]["fixed"]] = True
    assert np.array_equal(held.reshape(problem.shape), ~problem.free.numpy())
    session, model = OnnxSession(folder / "model.onnx"), found["model"]
    assert [one["name"] for one in model["inputs"]] == session.inputs
    assert [one["name"] for one in model["outputs"]] == ["displacement"]


def test_the_reference_has_the_displacements_of_surrogate_and_finite_elements(write_export):
    surrogate, folder, meta, found = write_export("fcnn")
    scene, entry = surrogate.scene, meta["reference"]
    assert entry["fe_converged"]
    assert entry["fe_residual"] < 1e-8 < entry["residual"]
    load = scene.load_of(torch.from_numpy(found["force"]), torch.from_numpy(found["young"]))
    exact = torch.from_numpy(found["fe_displacement"]) / scene.length
    assert float(scene.problem.relative_residual(exact, load.force)) < 1e-8
    session = OnnxSession(folder / "model.onnx")
    answer = session(force=found["force"], young=found["young"])["displacement"]
    assert relative_differences(answer, found["displacement"]) < 1e-5


def test_scales_and_weights_suffice_to_evaluate_the_network_without_this_package(write_export):
    """Evaluate the fully connected network in NumPy from meta.json and the weights."""
    from safetensors.numpy import load_file

    _, folder, meta, found = write_export("fcnn")
    weights, scales = load_file(folder / "weights.safetensors"), meta["scales"]
    unit = found["young"] * scales["force_unit"] * scales["force"]
    x = (found["force"].reshape(-1) / unit)[meta["dofs"]["loadable"]].astype(np.float32)
    stages = "predictor.net.stages"
    for k in (0, 2, 4, 6):
        x = weights[f"{stages}.{k}.weight"] @ x + weights[f"{stages}.{k}.bias"]
        if k < 6:
            x = np.where(x > 0, x, weights[f"{stages}.{k + 1}.weight"] * x)
    answer = np.zeros(meta["dofs"]["count"])
    answer[np.setdiff1d(np.arange(len(answer)), meta["dofs"]["fixed"])] = x
    answer *= scales["length"] * scales["displacement"]
    expected = found["displacement"].reshape(-1)
    assert np.linalg.norm(answer - expected) < 1e-5 * np.linalg.norm(expected)


def test_the_training_range_can_be_checked_without_this_package(write_export):
    surrogate, folder, meta, _ = write_export("fcnn")
    scene = surrogate.scene
    modes = np.fromfile(folder / "modes.f64", "<f8").reshape(meta["range"]["modes"]["shape"])
    load = scene.loads.sample((0, 13), range(6))
    load = fem.Load(
        torch.cat([load.force, 3 * load.force, torch.ones_like(load.force)]), load.young
    )
    amplitude, out_of_span = scene.loads.project(load.force)
    for k, force in enumerate(load.force.numpy()):
        force.reshape(-1)[meta["dofs"]["fixed"]] = 0.0
        acting = force.any(axis=1)
        shapes = modes[acting].reshape(-1, modes.shape[2])
        right = force[acting].reshape(-1)
        q = np.linalg.lstsq(shapes, right, rcond=None)[0]
        rest = np.linalg.norm(right - shapes @ q) / np.linalg.norm(force)
        assert abs(rest - float(out_of_span[k])) < 1e-6
        if k < 6:
            assert abs(q).max() == pytest.approx(float(amplitude[k]), rel=1e-6)
            assert np.linalg.norm(force) <= meta["range"]["largest_force"]


# ---------------------------------------------------------------------- consumers

SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("unrolled", "gnn", "pod")]
CONSUMED = ["cnn, poisson, 2D", "fcnn", *SLOW]


def copy_with_error(folder, tmp_path):
    """Return a copy of a folder whose reference displacement is 1 % larger."""
    other = tmp_path / "spoilt"
    shutil.copytree(folder, other)
    path = other / "reference" / "displacement.f64"
    path.write_bytes((1.01 * np.fromfile(path, "<f8")).tobytes())
    return other


def test_the_python_consumer_imports_only_numpy_and_onnxruntime():
    text = (CONSUMERS / "consumer.py").read_text()
    imported = {line.split()[1] for line in text.splitlines() if line.startswith("import")}
    assert imported == {"json", "sys", "numpy", "onnxruntime"}


def headers():
    """Return the folder of ONNX Runtime's headers, or None; wheels do not contain them."""
    root = os.environ.get("ONNXRUNTIME_ROOT")
    places = [Path(root) / "include"] if root else []
    places += [Path("/usr/include/onnxruntime"), Path("/usr/local/include/onnxruntime")]
    return next((path for path in places if (path / "onnxruntime_cxx_api.h").is_file()), None)


@pytest.fixture(scope="module", params=["python", "c++"])
def consumer(request, tmp_path_factory):
    """The command of a consumer; that in C++ is linked against the library in the wheel."""
    import onnxruntime

    if request.param == "python":
        return [sys.executable, str(CONSUMERS / "consumer.py")]
    compiler, include = shutil.which("g++"), headers()
    places = (Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*")
    needed = {
        "g++": compiler,
        "headers of ONNX Runtime; set ONNXRUNTIME_ROOT to the folder of include/": include,
        "libonnxruntime.so in the onnxruntime wheel": (library := next(places, None)),
    }
    if absent := [name for name, found in needed.items() if found is None]:
        pytest.skip(f"no {absent[0]}")
    folder = tmp_path_factory.mktemp("consumer")
    (folder / "libonnxruntime.so.1").symlink_to(library)
    program = folder / "consumer"
    command = [compiler, "-std=c++17", "-Wall", "-Werror", str(CONSUMERS / "consumer.cpp")]
    command += [f"-I{include}", str(folder / "libonnxruntime.so.1"), f"-Wl,-rpath,{folder}"]
    built = subprocess.run([*command, "-o", str(program)], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return [str(program)]


@pytest.mark.parametrize("name", CONSUMED)
def test_the_consumers_reproduce_the_reference(consumer, write_export, tmp_path, name):
    _, folder, _, _ = write_export(name)
    for place, status in ((folder, 0), (copy_with_error(folder, tmp_path), 1)):
        command = [*consumer, str(place)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == status, done.stderr
        assert "from the reference" in done.stdout

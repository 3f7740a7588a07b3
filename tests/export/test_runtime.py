"""The exported runtime file in C++: compiled with g++ and compared with Python."""

import ctypes
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

import dpl.fem as fem
from benchmarks.samples import solved
from dpl.export.runtime import FILE, FORMAT, HOME, LAWS, with_checksum, write_runtime
from dpl.models import Unrolled
from dpl.models.unrolled.compiled import law_arguments
from dpl.scene import Scene
from dpl.training import MSE, Surrogate
from tests.laws import LAWS as ALL_LAWS

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="no g++")

RUNTIME_LAWS = {
    name: law
    for name, law in ALL_LAWS.items()
    if getattr(type(law), "invariant_derivatives", None) in LAWS
} | {"demiray": fem.DemirayK2(a=0.4, b=2.0, poisson=0.3).normalised()}
OPENED = """
#include <iomanip>
#include <iostream>
#include "dpl_runtime.hpp"

int main(int argc, char** argv) {  // opens each file and prints the norm of an answer or the error
  for (int k = 1; k < argc; ++k) try {
      dpl::Simulator sim = dpl::Simulator::open(argv[k]);
      std::vector<double> force(3 * sim.nodes(), 1e-3 * sim.young);
      const double size = dpl::detail::norm(sim.solve(force.data()).displacement);
      std::cout << std::setprecision(17) << size << std::endl;
    } catch (const dpl::Error& error) {
      std::cout << "error: " << error.what() << std::endl;
    }
}
"""


class Report(ctypes.Structure):
    """`DplReport` of dpl_c.h."""

    _fields_ = (
        *((name, ctypes.c_double) for name in ("error", "residual", "volume_ratio")),
        *((name, ctypes.c_double) for name in ("amplitude", "out_of_span")),
        ("range", ctypes.c_int),
    )


class Body:
    """A body of the C interface."""

    def __init__(self, library, path):
        self.library, self.handle = library, library.dpl_open(str(path).encode())
        assert self.handle, library.dpl_message()
        self.count = library.dpl_node_count(self.handle)

    def __del__(self):
        self.library.dpl_close(self.handle)

    def solve(self, force):
        """Return displacement, that of the surface and report of a force (N, 3) [N]."""
        force = np.ascontiguousarray(force)
        surface = np.empty((self.library.dpl_surface_count(self.handle), 3))
        displacement, report = np.empty((self.count, 3)), Report()
        arrays = (each.ctypes.data for each in (force, displacement, surface))
        failed = self.library.dpl_solve(self.handle, *arrays, ctypes.byref(report))
        assert not failed, self.library.dpl_message()
        return displacement, surface, report


CHECKS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-DDPL_SCALAR"]
PROGRAMS = {  # options and source: with SIMD, checked without it, and the example
    "library": ["-O2", "-shared", "-fPIC", str(HOME / "dpl_c.cpp")],
    "opened": ["-O0", *CHECKS, "opened.cpp"],
    "loop": ["-O0", str(HOME / "loop.cpp")],
}


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """Function that returns the path of a program, which is compiled when it is first used."""
    folder = tmp_path_factory.mktemp("programs")
    (folder / "opened.cpp").write_text(OPENED)

    @cache
    def programs(name):
        command = ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{HOME}"]
        command += [*PROGRAMS[name], "-o", name]
        done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
        assert done.returncode == 0, done.stderr
        return folder / name

    return programs


@pytest.fixture(scope="module")
def library(programs):
    found = ctypes.CDLL(str(programs("library")))
    pointer, text, number = ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int
    for name, result, *arguments in (
        ("dpl_open", pointer, text),
        ("dpl_close", None, pointer),
        ("dpl_message", text),
        ("dpl_node_count", number, pointer),
        ("dpl_surface_count", number, pointer),
        ("dpl_surface", number, pointer, pointer),
        ("dpl_triangle_count", number, pointer),
        ("dpl_add_patch_force", number, pointer, text, pointer, pointer),
        ("dpl_set_young", number, pointer, ctypes.c_double),
        ("dpl_solve", number, pointer, pointer, pointer, pointer, pointer),
    ):
        function = getattr(found, name)
        function.restype, function.argtypes = result, arguments
    return found


def scene_on(mesh, law=None, **options):
    """Return a scene of a body that is held where x is smallest."""
    law = fem.NeoHookeanLn(0.3) if law is None else law
    problem = fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"), young=2e3, **options)
    newton = fem.Newton(problem, linear="superlu")
    loads = fem.ModalLoads(newton.linear_solver, n_modes=3, deflection=0.2, young=2e3)
    return Scene(problem, loads, newton)


def surrogate_of(scene):
    """Return a fitted model of a scene."""
    net = Unrolled(scene, rank=20, cells=8, stages=2)
    net.fit(*(solved(scene, scene.loads.sample(k, range(n))) for k, n in enumerate((30, 8))))
    return Surrogate(net, MSE(), scene).eval()


def sheared(points):
    """Return points (D, N) of a box as those of a body without symmetry or equal cells."""
    x, y, z = points
    return np.stack([x + 0.2 * x * y, y + 0.1 * x * z, z - 0.05 * x * y])


BODIES = {
    "equal hexahedra, eight symmetries": lambda: scene_on(fem.box((4, 1, 1), (5, 3, 3))),
    "hexahedra without symmetry": lambda: scene_on(
        (mesh := fem.box((3, 1, 1), (4, 3, 3))).__class__(sheared(mesh.p), mesh.t)
    ),
    "quadratic tetrahedra": lambda: scene_on(fem.box((2, 1, 1), (3, 2, 2), "tetra"), degree=2),
    "a moved end": lambda: scene_on(
        fem.box((4, 1, 1), (5, 3, 3)),
        supports=[fem.DirichletBC(fem.Plane(0, "max"), [0.0, 0.1, None])],
    ),
}


@pytest.fixture(scope="module", params=BODIES)
def body(request, library, tmp_path_factory):
    """A surrogate and its body in C++."""
    surrogate, folder = surrogate_of(BODIES[request.param]()), tmp_path_factory.mktemp("export")
    return surrogate, Body(library, write_runtime(folder, surrogate))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The beam with an estimated error, and its file."""
    surrogate = surrogate_of(BODIES["equal hexahedra, eight symmetries"]())
    return surrogate, write_runtime(tmp_path_factory.mktemp("beam"), surrogate)


@pytest.fixture(scope="module")
def beam(library, written):
    """The beam, its body in C++, and its file."""
    surrogate, path = written
    return surrogate, Body(library, path), path


def loads_of(scene):
    """Return loads in range, large ones, forces on single nodes, noise and no force."""
    load = scene.loads.sample(2, range(8))
    noise = torch.randn(2, *scene.problem.shape, generator=torch.Generator().manual_seed(0))
    force = torch.cat([load.force, 3 * load.force[:2], 1e-3 * noise.double(), 0 * noise.double()])
    single = torch.zeros_like(force[:4])
    ends = list(range(-4, 0))
    single[list(range(4)), ends] = 0.2 * scene.loads.modal_forces[ends].sum(dim=-1)
    force = torch.cat([force, single])
    young = torch.full((len(force),), 2e3).double()
    return load._replace(
        force=force, young=young, parameters=load.parameters.new_zeros(len(force), 0)
    )


def test_displacement_residual_volume_and_range_equal_those_of_python(body):
    surrogate, cpp = body
    scene, loads = surrogate.scene, loads_of(surrogate.scene)
    problem = scene.problem
    forces = scene.si_inputs(loads)["force"].numpy()
    amplitude, span = scene.loads.project(loads.force)
    inside = (amplitude <= 1 + 1e-9) & (span <= 1e-3)
    with torch.inference_mode():
        predicted = surrogate.predict(loads)
    for k, force in enumerate(forces):
        displacement, surface, report = cpp.solve(force)
        expected = scene.length * predicted[k].numpy()
        assert np.linalg.norm(displacement - expected) <= 1e-6 * np.linalg.norm(expected)
        assert np.array_equal(surface, displacement[problem.boundary.numpy()])
        found = problem.evaluate(torch.from_numpy(displacement)[None] / scene.length)
        residual = problem.relative_residual_of(found.internal, loads.force[k : k + 1])
        assert report.residual == pytest.approx(float(residual), rel=1e-8, abs=1e-12, nan_ok=True)
        assert report.volume_ratio == pytest.approx(float(found.volume_ratio), abs=1e-12)
        assert bool(report.range) == bool(inside[k])
        assert report.out_of_span == pytest.approx(float(span[k]), abs=1e-6)
        if np.count_nonzero(force) > 9:  # forces on one node have several amplitudes
            assert report.amplitude == pytest.approx(float(amplitude[k]), rel=1e-6)


@pytest.mark.parametrize("name", RUNTIME_LAWS)
def test_laws_equal_those_of_python(beam, library, tmp_path, name, monkeypatch):
    """Any law serves with the matrices of the neo-Hookean model; tensor operations judge it."""
    surrogate, _, path = beam
    net, scene, law = surrogate.net, surrogate.scene, RUNTIME_LAWS[name]
    constants = law_arguments(law)[1]
    arrays = load_file(path) | {"law_samples": constants, "law_cells": constants[:, :-2].copy()}
    kind = LAWS[type(law).invariant_derivatives] + ("" if law.finite else "_small_strains")
    words = WORDS | {"law": kind}
    (changed := tmp_path / FILE).write_bytes(with_checksum(arrays, words))
    cpp, problem = Body(library, changed), replace(scene.problem, material=law)
    loads = scene.loads.sample(3, range(2))
    cpu = torch.device("cpu")
    model, _, places = net._tensors(cpu)
    monkeypatch.setitem(net._kept, cpu, (model, law, places))
    predicted = net(loads.force.clone().requires_grad_()).detach()  # by tensor operations
    for k, force in enumerate(scene.si_inputs(loads)["force"].numpy()):
        displacement, _, report = cpp.solve(force)
        u = torch.from_numpy(displacement)[None] / scene.length
        assert (u - predicted[k]).norm() < 1e-5 * u.norm()  # float32 products
        internal = problem.internal_force(u)
        residual = problem.relative_residual_of(internal, loads.force[k : k + 1])
        assert report.residual == pytest.approx(float(residual), rel=1e-9)
        assert report.volume_ratio == pytest.approx(float(problem.volume_ratio(u)), rel=1e-12)


def test_the_error_in_range_is_that_of_the_model(beam):
    surrogate, cpp, _ = beam
    load = surrogate.scene.loads.sample(5, range(8))
    with torch.inference_mode():
        errors = surrogate.net.forward_with_errors(load.force)[1][:, 0]
    forces = surrogate.scene.si_inputs(load)["force"].numpy()
    reports = [cpp.solve(force)[2] for force in forces]
    pairs = [(r.error, float(e)) for r, e in zip(reports, errors, strict=True) if r.residual < 1]
    assert len(pairs) > 3, "where the residual exceeds the load the rotated stiffness decides"
    assert [found for found, _ in pairs] == pytest.approx([e for _, e in pairs], rel=1e-3)


def test_the_error_out_of_range_is_that_of_the_rotated_stiffness(beam):
    surrogate, cpp, _ = beam
    scene, load = surrogate.scene, surrogate.scene.loads.sample(6, range(1))
    load = load._replace(force=3 * load.force)
    displacement, _, report = cpp.solve(scene.si_inputs(load)["force"][0].numpy())
    u = torch.from_numpy(displacement)[None] / scene.length
    assert report.range == 0
    expected = fem.estimate_error(scene.linear, load, u, products=0).error
    assert report.error == pytest.approx(expected, rel=1e-3)


def test_a_force_on_a_patch_is_a_uniform_traction(beam, library):
    _, cpp, _ = beam
    force, total = np.zeros((cpp.count, 3)), np.array([1.0, 2.0, -3.0])
    arguments = total.ctypes.data, force.ctypes.data
    assert library.dpl_add_patch_force(cpp.handle, b"x_max", *arguments) == 0
    assert force.sum(axis=0) == pytest.approx(total)
    shares = np.unique(np.round(force[force[:, 0] != 0, 0], 9))
    assert shares == pytest.approx([1 / 16, 2 / 16, 4 / 16])  # corner, edge, middle
    assert library.dpl_add_patch_force(cpp.handle, b"top", *arguments) == -1
    assert library.dpl_message() == b"patch = top does not exist"


def test_the_displacement_depends_on_force_over_modulus(beam, library):
    surrogate, cpp, _ = beam
    force = surrogate.scene.si_inputs(surrogate.scene.loads.sample(7, [0]))["force"][0].numpy()
    first = cpp.solve(force)[0]
    assert library.dpl_set_young(cpp.handle, 4e3) == 0
    second = cpp.solve(2 * force)[0]
    assert library.dpl_set_young(cpp.handle, 2e3) == 0
    assert second == pytest.approx(first, rel=1e-12, abs=1e-15)
    assert library.dpl_set_young(cpp.handle, -1.0) == -1


def test_a_force_that_is_not_finite_is_an_error(beam, library):
    _, cpp, _ = beam
    force = np.full((cpp.count, 3), np.nan)
    assert library.dpl_solve(cpp.handle, force.ctypes.data, None, None, None) == -1
    assert library.dpl_message() == b"force must be finite"


# ---------------------------------------------------------------- files


def opened(programs, *paths):
    """Return the lines of the checked program, one for each file."""
    command = [programs("opened"), *paths]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


WORDS = {"format": FORMAT, "law": "neo_hookean_ln", "loads": "modal"}


def test_the_file_is_safetensors_and_read_without_simd_too(beam, programs):
    _, cpp, path = beam
    force = np.full((cpp.count, 3), 1e-3 * 2e3)
    expected = np.linalg.norm(cpp.solve(force)[0])
    rewritten = path.with_name("rewritten.safetensors")
    rewritten.write_bytes(with_checksum(load_file(path), WORDS))
    for line in opened(programs, path, rewritten):
        assert float(line) == pytest.approx(expected, rel=1e-9)


def test_damaged_files_end_in_one_line(written, programs, tmp_path):
    content, random = written[1].read_bytes(), np.random.default_rng(0)
    header = 8 + int.from_bytes(content[:8], "little")
    damaged = [content[:size] for size in (0, 7, 8, 9, header - 1, header, len(content) - 1)]
    damaged += [content[:size] for size in random.integers(0, len(content), 8)]
    places = [
        *range(8),
        *random.integers(8, header, 120),
        *random.integers(header, len(content), 20),
    ]
    for place in places:
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(random.integers(8))
        damaged.append(bytes(flipped))
    paths = [tmp_path / f"{k}.safetensors" for k in range(len(damaged))]
    for path, part in zip(paths, damaged, strict=True):
        path.write_bytes(part)
    lines = opened(programs, *paths, tmp_path / "absent")
    assert len(lines) == len(damaged) + 1
    assert all(line.startswith("error: ") for line in lines)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ({"law": "ogden"}, None),
        ({"format": "dpl runtime 0"}, None),
        ("cells", lambda a: a + 1000),
        ("dofs", lambda a: a - 10_000),
        ("columns", lambda a: a + 1000),
        ("front_unknowns", lambda a: a + 10_000),
        ("front_order", lambda a: a + 10_000),
        ("front_table", lambda a: a + np.array([0, 0, 0, 10_000_000])),
        ("front_table", lambda a: a[:, [1, 0, 2, 3]]),
        ("load_nodes", lambda a: -a),
        ("surface", lambda a: a + 1000),
        ("triangles", lambda a: a + 1000),
        ("patch.x_max.nodes", lambda a: a + 1000),
        ("modes", lambda a: a[:, :-1].copy()),
        ("modes", lambda a: a.astype(np.float64)),
        ("maps", lambda a: a[..., :-1].copy()),
        ("limits", lambda a: a[:-1].copy()),
        ("dN", lambda a: a * np.nan),
        ("dV", lambda a: np.concatenate([a, a])),
        ("law_cells", lambda a: a[:, :1].copy()),
        ("law_samples", lambda a: a[:, :1].copy()),
        ("young", lambda a: 0 * a),
        ("load_span", lambda a: 0 * a),
        ("blocks", lambda a: a[:, :-1].copy()),
    ],
)
def test_words_and_arrays_that_do_not_fit_end_in_one_line(
    written, programs, tmp_path, name, change
):
    arrays, words = load_file(written[1]), WORDS
    if change is None:
        words = WORDS | name
    else:
        arrays[name] = np.ascontiguousarray(change(arrays[name]))
    (path := tmp_path / FILE).write_bytes(with_checksum(arrays, words))
    (line,) = opened(programs, path)
    assert line.startswith("error: " if change is None else "error: runtime file ")


def test_a_file_without_sample_cells_ends_in_one_line(written, programs, tmp_path):
    arrays = load_file(written[1])
    first = "gradients", "rest", "entry_signs", "first_signs", "first_map"
    for name in (*first, "map_signs", "maps"):
        arrays[name] = arrays[name][..., :0].copy()
    arrays["law_samples"] = arrays["law_samples"][:0].copy()
    (path := tmp_path / FILE).write_bytes(with_checksum(arrays, WORDS))
    (line,) = opened(programs, path)
    assert line.startswith("error: runtime file ")


def test_the_example_prints_error_and_time_of_each_frame(written, programs):
    command = [programs("loop"), written[1], "3", "0.5"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    head, names, *frames = done.stdout.splitlines()
    assert head == "45 nodes, 42 of the surface"
    assert [len(frame.split()) for frame in frames] == [len(names.split())] * 3
    missing = subprocess.run([programs("loop"), "none"], capture_output=True, text=True)
    assert (missing.returncode, missing.stderr) == (1, "error: none cannot be read\n")


# ---------------------------------------------------------------- bodies that it cannot simulate


BEAM = fem.box((2, 1, 1), (3, 2, 2))
FOUNDATION = fem.RobinBC(fem.Plane(1, "min"), 1.0)
PRESSURE = fem.FollowerPressure(fem.Plane(1, "min"), 1e-3)
REFUSED = {
    "three-dimensional": lambda: scene_on(fem.rectangle((4, 1), (5, 2))),
    r"no ranges \['poisson'\]": lambda: scene_on(BEAM, fem.NeoHookeanLn((0.1, 0.4))),
    "one of the laws": lambda: scene_on(BEAM, ALL_LAWS["ogden_k2"]),
    "no elastic foundation": lambda: scene_on(BEAM, supports=[FOUNDATION]),
    "no follower loads": lambda: scene_on(BEAM, follower_loads=[PRESSURE]),
    "no mean dilatation": lambda: scene_on(BEAM, mean_dilatation=True),
    "fitted with model=unrolled": lambda: scene_on(BEAM),
}


@pytest.mark.parametrize("message", REFUSED)
def test_bodies_without_a_runtime_are_refused(tmp_path, message):
    surrogate = SimpleNamespace(net=torch.nn.Identity(), scene=REFUSED[message]())
    with pytest.raises(ValueError, match=message):
        write_runtime(tmp_path, surrogate)
    assert not list(tmp_path.iterdir())

"""Damaged mesh files give an error in one line or a valid mesh."""

import contextlib
import functools
import io
import os
import re
import tempfile
import warnings
from pathlib import Path

import meshio
import numpy as np
import pytest
import skfem
from bounds import Late, at_most, bounded
from hypothesis import given, settings
from hypothesis import strategies as st
from skfem.io.meshio import to_meshio

from dpl.fem import box, read_mesh, rectangle
from dpl.fem.mesh import check_mesh, sandbox

BODIES = {
    "hexahedron": box([2.0, 1.0, 1.0], [3, 2, 2]),
    "tetra": box([2.0, 1.0, 1.0], [3, 2, 2], "tetra"),
    "quad": rectangle([2.0, 1.0], [3, 2]),
    "triangle": rectangle([2.0, 1.0], [3, 2], "triangle"),
}
KINDS = {  # name: format of meshio, suffix, options
    "vtu ascii": ("vtu", "vtu", {"binary": False}),
    "vtu binary": ("vtu", "vtu", {"compression": None}),
    "vtu zlib": ("vtu", "vtu", {}),
    "vtu lzma": ("vtu", "vtu", {"compression": "lzma"}),
    "vtk 5.1 ascii": ("vtk", "vtk", {"binary": False}),
    "vtk 5.1 binary": ("vtk", "vtk", {}),
    "vtk 4.2 ascii": ("vtk42", "vtk", {"binary": False}),
    "vtk 4.2 binary": ("vtk42", "vtk", {}),
    "msh 2.2 ascii": ("gmsh22", "msh", {"binary": False}),
    "msh 2.2 binary": ("gmsh22", "msh", {}),
    "msh 4.1 ascii": ("gmsh", "msh", {"binary": False}),
    "msh 4.1 binary": ("gmsh", "msh", {}),
    "ansys ascii": ("ansys", "msh", {"binary": False}),
    "ansys binary": ("ansys", "msh", {}),
    "abaqus": ("abaqus", "inp", {}),
    "nastran": ("nastran", "nas", {}),
    "su2": ("su2", "su2", {}),
    "medit ascii": ("medit", "mesh", {}),
    "medit binary": ("medit", "meshb", {}),
    "netgen": ("netgen", "vol", {}),
    "permas": ("permas", "post", {}),
    "avs": ("avsucd", "avs", {}),
    "tecplot": ("tecplot", "dat", {}),
    "flac3d": ("flac3d", "f3grid", {}),
    "mdpa": ("mdpa", "mdpa", {}),
}
COUNTED = ("vtu", "vtk", "vtk42", "gmsh", "gmsh22", "su2", "medit")  # tell how many cells they hold
TEXTS = [b"nan", b"inf", b"-1", b"0", b"1", b"6", b"1e308", b"1e-320", b"1.5", b"", b"abc"]
TEXTS += [str(n).encode() for n in (999999999999, 2**31, -(2**31) - 1, 2**63, 20_000_001, 3000000)]
NUMBERS = [0, 1, -1, 2**31 - 1, -(2**31), 20_000_001, 7, 8]


@functools.cache
def good(kind: str, cell: str) -> bytes | None:
    """Return a good file with tags, or None where the format has no such cells."""
    name, suffix, options = KINDS[kind]
    body = BODIES[cell]
    mesh = to_meshio(body)
    points, numbers = mesh.points, np.arange(body.nelements) % 2 + 1
    if body.dim() == 2 and name != "su2":
        points = np.pad(points, ((0, 0), (0, 1)))
    made = meshio.Mesh(points, [(cell, mesh.cells[0].data.astype(np.int64))])
    if name.startswith("gmsh"):
        made.cell_data = {"gmsh:physical": [numbers], "gmsh:geometrical": [numbers]}
        made.field_data = {"one": np.array([1, body.dim()]), "two": np.array([2, body.dim()])}
    elif name in ("vtu", "vtk", "vtk42"):
        made.cell_data, made.point_data = {"part": [numbers]}, {"x": points[:, 0]}
    elif name == "abaqus":
        made.cell_sets, made.point_sets = {"part": [[0]]}, {"some": [0, 1]}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"good.{suffix}"
        with contextlib.redirect_stderr(io.StringIO()):
            try:
                meshio.write(path, made, file_format=name, **options)
            except (meshio.WriteError, KeyError, AssertionError):
                return None
        again = read_mesh(path)
        assert sorted(map(tuple, again.p.T)) == sorted(map(tuple, body.p.T))
        return path.read_bytes()


def changed(data: bytes, change: tuple) -> bytes:
    """Return the bytes with one change; places are fractions of the length."""
    what, at, size, value = change
    start = int(at * len(data))
    end = min(len(data), start + size)
    if what == "cut":
        return data[:start]
    if what == "delete":
        return data[:start] + data[end:]
    if what == "repeat":
        return data[:end] + data[start:]
    if what == "flip":
        return data[:start] + bytes([data[start] ^ (1 << size % 8)]) + data[start + 1 :]
    if what == "insert":
        return data[:start] + TEXTS[value] + data[start:]
    if what == "binary":
        width = 4 if size % 2 else 8
        return data[:start] + NUMBERS[value % len(NUMBERS)].to_bytes(
            width, "big" if size % 4 > 1 else "little", signed=True
        ) + data[start + width :]  # fmt: skip
    lines = data.split(b"\n")
    one, two = int(at * len(lines)), (int(at * len(lines)) + size) % len(lines)
    if what == "swap":
        lines[one], lines[two] = lines[two], lines[one]
    elif what == "twice":
        lines.insert(two, lines[one])
    elif what == "drop":
        del lines[one]
    if what in ("swap", "twice", "drop"):
        return b"\n".join(lines)
    found = list(re.finditer(rb"[-+]?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?", data))  # "number"
    if not found:
        return data
    place = found[int(at * len(found))]
    return data[: place.start()] + TEXTS[value] + data[place.end() :]


WAYS = ("cut", "delete", "repeat", "flip", "insert", "binary", "swap", "twice", "drop")
CHANGES = st.tuples(
    st.sampled_from((*WAYS, "number", "number", "number")),
    st.floats(0, 1, exclude_max=True),
    st.integers(1, 60),
    st.integers(0, len(TEXTS) - 1),
)


@pytest.fixture(autouse=True)
def _limits(request, monkeypatch):
    """Limit the CPU time of a reader and wait for it; read a few files in this process."""
    monkeypatch.setattr(sandbox, "SECONDS", (2.0, 0.0))
    monkeypatch.setattr(sandbox, "WAIT", 100.0)
    if settings.default.max_examples < 100:
        request.getfixturevalue("in_process")


def tried(path: Path) -> skfem.Mesh | None:
    """Return the mesh, or None after an error in one line; hold `read_mesh` to how it may fail."""
    files = sorted(os.listdir(path.parent))
    said = io.StringIO()
    with (
        bounded(seconds=3, memory=0.35),
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("always")
        mesh = None
        try:
            mesh = read_mesh(path)
        except Late:  # a process of its own would be ended
            assert settings.default.max_examples < 100
        except ValueError as error:
            text = str(error)
            assert text.startswith(f"{path}: ")
            assert text.isprintable()
            assert len(text) < 1000
            assert "crashed" not in text
    assert said.getvalue() == ""
    assert sorted(os.listdir(path.parent)) == files
    return mesh


def sound(mesh: skfem.Mesh) -> bool:
    """Return True for a mesh that can be solved."""
    check_mesh(mesh)
    used = np.unique(mesh.t)
    tags = [*(mesh.boundaries or {}).values(), *(mesh.subdomains or {}).values()]
    volumes = skfem.Basis(mesh, mesh.elem(), intorder=4).dx.sum(axis=1)
    return (
        np.isfinite(mesh.p).all()
        and np.array_equal(used, np.arange(mesh.nvertices))
        and np.isfinite(volumes).all()
        and volumes.min() > 0
        and all(np.min(tag, initial=0) >= 0 for tag in tags)
    )


@pytest.mark.parametrize("kind", KINDS)
@at_most(0.2)
@given(cell=st.sampled_from(list(BODIES)), changes=st.lists(CHANGES, min_size=1, max_size=3))
def test_a_damaged_file_is_an_error_in_one_line_or_a_sound_mesh(
    kind, cell, changes, tmp_path_factory
):
    """Where the format counts its cells, none is lost unless the file was changed for it."""
    data = good(kind, cell)
    if data is None:
        return
    whole = BODIES[cell]
    for change in changes:
        if data:
            data = changed(data, change)
    path = tmp_path_factory.mktemp("damaged") / f"file.{KINDS[kind][1]}"
    path.write_bytes(data)
    mesh = tried(path)
    if mesh is None:
        return
    assert sound(mesh)
    if all(change[0] == "cut" for change in changes):
        assert np.array_equal(mesh.p, whole.p)
    if KINDS[kind][0] in COUNTED and type(mesh) is type(whole):
        small = {"flip", "cut", "swap", "number", "insert", "drop"}
        if len(changes) == 1 and changes[0][0] in small:
            assert mesh.nelements == whole.nelements
            assert mesh.nvertices == whole.nvertices

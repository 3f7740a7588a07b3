"""Hostile and damaged mesh files are refused in one line, within limits of memory and time."""

import base64
import itertools
import lzma
import os
import resource
import struct
import subprocess
import sys
import zlib

import meshio
import numpy as np
import pytest

from benchmarks.stress.broken_meshes import CORNERS, FAN, PATCH, TETS, TWO_CUBES, TWO_HEXES, write
from dpl.fem import box, read_mesh, rectangle
from dpl.fem.mesh import sandbox
from dpl.fem.mesh.reading import to_mesh


@pytest.fixture(autouse=True)
def _patience(monkeypatch):
    """Wait for the reader on a busy machine: its own limit is CPU time."""
    monkeypatch.setattr(sandbox, "WAIT", 100.0)


@pytest.fixture
def few_seconds(monkeypatch):
    """Limit the CPU time of a reader to little more than its start takes."""
    monkeypatch.setattr(sandbox, "SECONDS", (2.0, 0.0))


def refused(path, match: str) -> None:
    """Assert that `read_mesh` raises one line that names the file, and allocates little memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=match) as error:
        read_mesh(path)
    text = str(error.value)
    assert text.startswith(f"{path}: ")
    assert text.isprintable()
    assert len(text) < 1000
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # [kB]


def cube(tmp_path, name: str = "cube.vtu", **options):
    """Return a good file."""
    path = tmp_path / name
    meshio.write(path, meshio.Mesh(CORNERS, [("tetra", TETS)]), **options)
    return path


def replaced(path, old: str, new: str):
    """Replace a text that is there in a file."""
    text = path.read_bytes()
    assert old.encode() in text
    path.write_bytes(text.replace(old.encode(), new.encode(), 1))
    return path


LAUGHS = """<!DOCTYPE lolz [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>"""
OUTSIDE = """<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]>"""
GMSH, GMSH22 = ({"file_format": name, "binary": False} for name in ("gmsh", "gmsh22"))
ENTITIES = (LAUGHS, OUTSIDE, "<!DOCTYPE x SYSTEM 'http://localhost/x'>")
DEEP = "<VTKFile type='UnstructuredGrid'>" + "<a>" * 10**5
HDF = b"\x89HDF\r\n\x1a\n" + bytes(100)
XDMF = """<Xdmf Version="3.0"><Domain><Grid><Geometry GeometryType="XYZ">
<DataItem Dimensions="8 3" Format="Binary">/etc/passwd</DataItem>
</Geometry></Grid></Domain></Xdmf>"""
VTK = "# vtk DataFile Version 4.2\nx\nASCII\nDATASET "
GMSH2, GMSH4 = (f"$MeshFormat\n{version} 0 8\n$EndMeshFormat\n" for version in ("2.2", "4.1"))
BINARY = b"$MeshFormat\n4.1 1 8\n" + struct.pack("i", 1) + b"\n$EndMeshFormat\n$Nodes\n"
ENDLESS = "more memory|ends too early|longer than"
IN_PROCESS = pytest.mark.usefixtures("in_process")  # where a check refuses, before meshio reads
DAMAGED = "cannot be read as a mesh"
FORBIDDEN = [  # suffix, content, message
    *[
        (suffix, f'<?xml version="1.0" encoding="{code}"?>{text}<VTKFile>x</VTKFile>'.encode(code),
         "document type or entities")
        for suffix, text, code in (
            *(("vtu", text, "utf-8") for text in ENTITIES),
            *(("xdmf", LAUGHS, "utf-16"), ("xmf", OUTSIDE, "utf-8"), ("xml", LAUGHS, "utf-8")),
        )
    ],
    # files of HDF5 can hold links to others
    *[(s, HDF, "h5py|netCDF4|cannot be read") for s in ("h5m", "med", "cgns", "hmf", "e")],
    # counts beyond the size of the file
    ("msh", GMSH2 + "$Nodes\n999999999999\n", "must hold one section"),
    ("msh", GMSH4 + "$Nodes\n1 999999999999 1 1\n", "must hold one section"),
    ("msh", GMSH2 + "$Elements\n999999999999\n", "must hold one section"),
    ("msh", BINARY + struct.pack("4Q", 1, 10**12, 1, 10**12), "must hold one section"),
    ("msh", GMSH2 + "$NodeData\n999999999\n", "must hold"),
    ("msh", GMSH2 + "$Nodes\n1000000\n1 0 0 0\n$EndNodes\n", DAMAGED),
    ("vtk", VTK + "UNSTRUCTURED_GRID\nPOINTS 99999999 double\n", DAMAGED),
    ("vtk", VTK + "UNSTRUCTURED_GRID\nCELL_TYPES 99999 double\n", DAMAGED),
    ("su2", "NDIME= 3\nNPOIN= 999999999999\n", "cannot be read|holds no cells"),
    ("dat", 'TITLE = "x"\nVARIABLES = "X"\n', "cannot be read"),
]  # fmt: skip
HOSTILE = [
    ("vtu", DEEP, DAMAGED),
    ("vtu", DEEP + "</a>" * 10**5 + "</VTKFile>", DAMAGED),
    ("xdmf", XDMF, "h5py|netCDF4|cannot be read"),
    ("vtk", VTK + "STRUCTURED_POINTS\nDIMENSIONS 9999 9999 9999\n", DAMAGED),
]


@pytest.mark.parametrize(
    ("suffix", "content", "match"), [*HOSTILE, *FORBIDDEN], ids=itertools.count()
)
def test_hostile_files_are_refused(tmp_path, suffix, content, match, request):
    if (suffix, content, match) not in HOSTILE:
        request.getfixturevalue("in_process")
    path = tmp_path / f"hostile.{suffix}"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    refused(path, match)


@IN_PROCESS
@pytest.mark.parametrize(
    ("name", "options", "old", "new", "match"),
    [
        *[
            ("a.vtu", {}, f'{key}="{number}"', f'{key}="{count}"', "cannot be read as a mesh")
            for key, number in (("NumberOfPoints", len(CORNERS)), ("NumberOfCells", len(TETS)))
            for count in (10**12, 10**8, 1)
        ],
        ("a.vtu", {"binary": False}, 'Name="offsets"', 'Name="faces"', "cannot be read as a mesh"),
        *[
            ("a.msh", form, f"$End{block}", f"9 1 1 1 1\n$End{block}", "more or fewer rows than it")
            for form in (GMSH, GMSH22)
            for block in ("Nodes", "Elements")
        ],
        # meshio leaves what it finds in memory in place of missing nodes
        ("a.msh", GMSH, "$Nodes\n1 8 1 8\n", "$Nodes\n1 9 1 9\n", "fewer rows than it declares"),
    ],
)  # fmt: skip
def test_counts_that_contradict_the_content_are_refused(tmp_path, name, options, old, new, match):
    refused(replaced(cube(tmp_path, name, **options), old, new), match)


@IN_PROCESS
def test_dolfin_xml_is_refused(tmp_path):
    """Meshio leaves rows that such a file declares and does not list undefined."""
    path = tmp_path / "cube.xml"
    meshio.write(path, meshio.Mesh(CORNERS, [("tetra", TETS)]), file_format="dolfin-xml")
    refused(path, "DOLFIN XML, which is not read; convert it")


def packed(data: bytes, *, blocks: int = 1, squeeze=zlib.compress) -> str:
    """Return a block of compressed data of a .vtu file, with a header that lies about its size."""
    part = squeeze(data)
    header = struct.pack(f"<{3 + blocks}I", blocks, 100, 100, *[len(part)] * blocks)
    return base64.b64encode(header).decode() + base64.b64encode(part * blocks).decode()


VTU = """<?xml version="1.0"?>
<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian" compressor="{compressor}">
<UnstructuredGrid><Piece NumberOfPoints="8" NumberOfCells="1">
<Points><DataArray type="Float64" NumberOfComponents="3" format="{kind}" offset="0">{here}</DataArray></Points>
<Cells><DataArray type="Int64" Name="connectivity" format="ascii">{nodes}</DataArray>
<DataArray type="Int64" Name="offsets" format="ascii">{offsets}</DataArray>
<DataArray type="UInt8" Name="types" format="ascii">{types}</DataArray></Cells>
</Piece></UnstructuredGrid>{after}</VTKFile>"""  # noqa: E501
GOOD = {
    "compressor": "vtkZLibDataCompressor", "kind": "binary", "after": "",
    "nodes": "0 1 2 3 4 5 6 7", "offsets": "8", "types": "12",
}  # fmt: skip


@pytest.mark.parametrize(("compressor", "kind"), [("ZLib", "binary"), ("LZMA", "appended")])
def test_data_that_unpack_beyond_the_memory_limit_are_refused(
    tmp_path, kind, compressor, monkeypatch
):
    monkeypatch.setattr(sandbox, "MEMORY", (2**28, 0))
    squeeze = zlib.compress if compressor == "ZLib" else lzma.compress
    text = packed(bytes(100 * 2**20), blocks=3, squeeze=squeeze)
    values = GOOD | {"compressor": f"vtk{compressor}DataCompressor", "kind": kind, "here": text}
    if kind == "appended":
        after = f'<AppendedData encoding="base64">_{text}</AppendedData>'
        values |= {"here": "", "after": after}
    path = tmp_path / "bomb.vtu"
    path.write_text(VTU.format(**values))
    refused(path, "more memory than")
    assert read_mesh(cube(tmp_path)).t.shape[0] == 4


@IN_PROCESS
def test_the_vtu_of_the_bombs_is_good_without_one(tmp_path):
    path = tmp_path / "good.vtu"
    path.write_text(VTU.format(**GOOD, here=packed(CORNERS.astype("<f8").tobytes())))
    assert read_mesh(path).nelements == 1


@pytest.mark.parametrize(
    ("nodes", "offsets", "types"),
    [
        ("0 1 2 3 4 5 6 7", "7", "12"),
        ("0 1 2 3 4 5 6 7 7", "9", "12"),
        ("0 1 2 3 4 5 6 7", "8", "11"),  # a voxel, which meshio leaves out
        ("0 1 2 3 4 5 6 7", "8", "10"),  # the last four would make a tetrahedron
        ("0 1 2 3 4 5 6 7", "1000000000", "7"),  # a polygon
    ],
)
def test_offsets_must_fit_the_cells(tmp_path, nodes, offsets, types, request):
    if types != "7":
        request.getfixturevalue("in_process")
    path = tmp_path / "bad.vtu"
    here = packed(CORNERS.astype("<f8").tobytes())
    path.write_text(
        VTU.format(**(GOOD | {"nodes": nodes, "offsets": offsets, "types": types}), here=here)
    )
    refused(path, "types or the offsets of its cells|more memory|damaged")


def test_xdmf_is_refused(tmp_path):
    """Its data may lie in other files, and meshio reads it with h5py only."""
    pytest.importorskip("h5py")
    path = cube(tmp_path, "cube.xdmf", data_format="Binary")
    refused(path, "h5py, which is not read; convert it")


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        # tables by the largest number: 16 GB
        ("a.msh", GMSH2 + "$Nodes\n1\n2000000000 0 0 0\n$EndNodes\n"
         "$Elements\n1\n1 15 0 2000000000\n$EndElements\n", ENDLESS),
        ("d.mesh", "MeshVersionFormatted 2\nDimension 3\nRidges\n99999999999\n", ENDLESS),
        ("a.mdpa", "Begin Nodes\n", "longer than"),  # meshio looks for a node after the end
    ],
)  # fmt: skip
def test_files_that_need_much_memory_or_time_are_refused(tmp_path, name, text, match, few_seconds):
    (tmp_path / name).write_text(text)
    refused(tmp_path / name, match)


def test_a_reader_that_does_not_answer_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(sandbox, "WAIT", 1e-9)
    refused(cube(tmp_path), "longer than")


def test_abaqus_files_that_include_others_are_refused(tmp_path):
    path = cube(tmp_path, "a.inp")
    whole = path.read_text()
    (tmp_path / "other.inp").write_text("*HEADING\n")
    for line, match in (
        ("*INCLUDE, INPUT=other.inp", "includes another file"),
        ("*include,input=/etc/passwd", "includes another file"),
        ("*INCLUDE, INPUT=a.inp", "includes another file"),
    ):
        path.write_text(f"{whole}{line}\n")
        refused(path, match)
    path.write_text(whole + "** INCLUDE, this is a comment\n")
    assert read_mesh(path).t.shape[0] == 4


def test_the_reader_opens_no_other_file_and_no_connection(tmp_path):
    """Run in a process of its own: a hook cannot be removed."""
    program = (
        "import os, socket, subprocess, sys\n"
        "from dpl.fem.mesh.sandbox_checks import Refused\n"
        "from dpl.fem.mesh.sandbox_worker import restrict_access\n"
        "restrict_access(os.path.realpath(sys.argv[1]))\n"
        "open(sys.argv[1]).close()\n"
        "calls = [lambda: open('/etc/passwd'), lambda: open(sys.argv[1], 'a'),\n"
        "    lambda: os.open('/etc/passwd', os.O_RDONLY), lambda: os.remove(sys.argv[1]),\n"
        "    lambda: socket.create_connection(('127.0.0.1', 9)),\n"
        "    lambda: os.system('true'), lambda: subprocess.run(['true']), lambda: os.fork()]\n"
        "for call in calls:\n"
        "    try:\n"
        "        call()\n"
        "    except Refused:\n"
        "        continue\n"
        "    sys.exit('allowed')\n"
    )
    path = cube(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("suffix", ["vtu", "h5m"])
def test_pipes_and_devices_are_refused_and_folders_are_no_files(tmp_path, suffix):
    os.mkfifo(tmp_path / f"pipe.{suffix}")
    refused(tmp_path / f"pipe.{suffix}", "pipe")
    (tmp_path / f"zero.{suffix}").symlink_to("/dev/zero")
    refused(tmp_path / f"zero.{suffix}", "device")
    (tmp_path / f"folder.{suffix}").mkdir()
    with pytest.raises(FileNotFoundError, match="folder"):
        read_mesh(tmp_path / f"folder.{suffix}")
    with pytest.raises(FileNotFoundError, match=r"none\.vtu: no such"):
        read_mesh(tmp_path / "none.vtu")
    with pytest.raises(FileNotFoundError, match="no such"):
        read_mesh(tmp_path / f"no\0ne.{suffix}")


def test_files_of_more_than_four_gigabytes_are_refused(tmp_path):
    path = tmp_path / "large.vtu"
    with path.open("wb") as file:
        file.truncate(sandbox.MAX_BYTES + 1)  # takes no room
    refused(path, "GiB")


@IN_PROCESS
def test_a_path_from_the_working_folder_is_found(tmp_path, monkeypatch):
    cube(tmp_path)
    for folder in (tmp_path, tmp_path.parent):
        monkeypatch.chdir(folder)
        assert read_mesh((tmp_path / "cube.vtu").relative_to(folder)).t.shape[0] == 4


@IN_PROCESS
@pytest.mark.parametrize(
    ("value", "flaw"),
    [("nan", "not finite"), ("-inf", "not finite"), ("1e60", "above"), ("-1e308", "above")],
)
def test_coordinates_without_a_volume_are_an_error(tmp_path, value, flaw, recwarn):
    """NaN would pass a comparison of distances from the plane of a 2D mesh."""
    flat, solid = PATCH.astype(float), TWO_CUBES.astype(float)
    flat[2, 2] = solid[2, 1] = float(value)
    refused(write(tmp_path / "a.vtu", flat, triangle=FAN), f"1 nodes are {flaw}.*: 2")
    refused(write(tmp_path / "b.vtu", solid, hexahedron=TWO_HEXES), f"1 nodes are {flaw}.*: 2")
    assert not recwarn


@IN_PROCESS
def test_elements_of_gmsh_have_the_length_of_their_type(tmp_path):
    """Meshio takes the last nodes of a row: a triangle of a quadrilateral."""
    mesh = rectangle([2.0, 1.0], [3, 2])
    points = np.pad(mesh.p.T, ((0, 0), (0, 1)))
    path = tmp_path / "a.msh"
    meshio.write(
        path, meshio.Mesh(points, [("quad", mesh.t.T)]), file_format="gmsh22", binary=False
    )
    refused(replaced(path, "\n1 3 ", "\n1 2 "), "length of its type")


@IN_PROCESS
def test_nodes_of_gmsh_count_from_one(tmp_path):
    """Zero would be the last one."""
    path = cube(tmp_path, "a.msh", file_format="gmsh22", binary=False)
    lines = path.read_text().split("\n")
    row = lines.index("$Elements") + 2
    lines[row] = " ".join([*lines[row].split()[:-1], "0"])
    path.write_text("\n".join(lines))
    refused(path, "node 0, nodes count from 1")


@IN_PROCESS
@pytest.mark.parametrize(("kind", "nodes"), [("wedge", 6), ("pyramid", 5), ("hexahedron20", 20)])
def test_solid_cells_of_other_kinds_are_not_left_out(tmp_path, kind, nodes):
    """A body of hexahedra and wedges would have holes."""
    cells = {"hexahedron": TWO_HEXES, kind: np.arange(nodes)[None] % len(TWO_CUBES)}
    refused(write(tmp_path / "mixed.vtu", TWO_CUBES, **cells), "holds hexahedron and ")


@IN_PROCESS
def test_many_nodes_in_one_place_are_told_without_listing_their_pairs(tmp_path):
    """2,000 cubes in one place have 16 million pairs of nodes."""
    number = 2000
    cells = np.arange(8)[[0, 1, 3, 2, 4, 5, 7, 6]] + 8 * np.arange(number)[:, None]
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    path = write(tmp_path / "crowd.vtu", np.tile(corners, (number, 1)), hexahedron=cells)
    with pytest.raises(ValueError, match="2000 nodes coincide in one place: 0, 8, 16"):
        read_mesh(path)


def test_sets_name_nodes_and_cells_that_there_are(tmp_path):
    mesh = box([2.0, 1.0, 1.0], [3, 2, 2], "tetra")
    for nodes in ([-1, 3], [0, 99]):
        raw = meshio.Mesh(mesh.p.T, [("tetra", mesh.t.T)], point_sets={"a": np.array(nodes)})
        with pytest.raises(ValueError, match="the set 'a' = "):
            to_mesh(raw)

"""Checks of mesh files for errors that meshio does not report.

Meshio returns a mesh with missing or wrong cells where counts, offsets or node numbers of a file
contradict each other. The checks run in the process of `dpl.fem.mesh.sandbox_worker`.
"""

import contextlib
import re
import struct
from pathlib import Path
from typing import Any
from xml.parsers import expat

import meshio
import numpy as np
from meshio._common import num_nodes_per_cell
from meshio.gmsh.common import _gmsh_to_meshio_type
from meshio.vtu._vtu import VtuReader

CONVERT = "which is not read; convert it with 'meshio convert' if you trust it"
GMSH_NODES = {kind: num_nodes_per_cell[name] for kind, name in _gmsh_to_meshio_type.items()}

PERMAS = ("$COOR", r"^\$*COOR[^\n]*\n([^$!]*)")
NODE_BLOCKS = {  # name and pattern of the blocks of nodes, by suffix
    ".inp": ("*NODE", r"^\*\s*NODE\s*(?:,[^\n]*)?\n([^*]*)"),
    ".dato": PERMAS,
    ".post": PERMAS,
}


class Refused(ValueError):
    """A file that is not read; the message says why."""


def check_file(path: Path) -> None:
    """Refuse files that declare entities or list a node number twice, before they are read.

    Of several blocks of nodes, meshio would lose all but the last.
    """
    suffix = path.suffix.lower()
    if suffix in (".vtu", ".xdmf", ".xmf", ".xml"):
        parser = expat.ParserCreate()
        parser.StartDoctypeDeclHandler = _refuse_doctype
        with contextlib.suppress(expat.ExpatError), path.open("rb") as file:
            parser.ParseFile(file)
    if suffix == ".xml":  # rows that it declares and does not list would be undefined numbers
        raise Refused(f"its format is DOLFIN XML, {CONVERT}")
    if suffix in NODE_BLOCKS:
        name, pattern = NODE_BLOCKS[suffix]
        blocks = re.findall(pattern, path.read_text(errors="replace"), re.M | re.I)
        if len(blocks) > 1:
            raise Refused(f"it holds {len(blocks)} blocks {name}; join them in one")
        for block in blocks:
            lines = [line.replace(",", " ").split() for line in block.splitlines()]
            _check_unique([int(row[0]) for row in lines if row])
    if suffix == ".avs":
        lines = path.read_text(errors="replace").splitlines()
        rows = [line.split() for line in lines if line.partition("#")[0].strip()]
        if rows:
            _check_unique([int(float(row[0])) for row in rows[1 : 1 + int(rows[0][0])]])
    if suffix == ".msh":
        _check_gmsh(path.read_bytes())


def _refuse_doctype(*_: Any) -> None:
    raise Refused("it has a document type or entities, which no mesh needs; remove them")


def _check_unique(numbers: Any) -> None:
    """Refuse node numbers (N,) that occur twice."""
    found, count = np.unique(numbers, return_counts=True)
    twice = [str(int(number)) for number in found[count > 1]]
    if twice:
        listed = f"{len(twice)} node numbers are listed more than once: {', '.join(twice[:5])}"
        raise Refused(f"{listed}; number each node once")


def _check_gmsh(data: bytes) -> None:
    """Compare the nodes and elements of a Gmsh file with their declared counts and types."""
    form = re.search(rb"\$MeshFormat\s+(\d(?:\.\d)?)\s+([01])\s", data)
    if not form:  # a file of Ansys
        return
    if form[1] == b"4.0":
        raise Refused("it has version 4.0 of the format; save it in version 4.1 or 2.2")
    for name in ("Nodes", "Elements"):
        pattern = rb"^\$%b[ \t\r]*\n(.*?)^\$End%b[ \t\r]*$" % (name.encode(), name.encode())
        sections = re.findall(pattern, data, re.M | re.S)
        if len(sections) != 1:
            raise Refused(f"it must hold one section ${name} that ends with $End{name}")
        try:
            if form[2] == b"0":
                rows = [row.split() for row in sections[0].splitlines() if row.strip()]
            else:
                unpack = _binary_rows2 if form[1] < b"3" else _binary_rows4
                rows, end = unpack(name, sections[0])
                if not 0 <= len(sections[0]) - end <= 2:  # an end of line
                    raise IndexError
            _check_rows(name, rows, blocks=form[1] > b"3")
        except (KeyError, IndexError, struct.error):
            raise Refused(f"${name} holds more or fewer rows than it declares") from None


def _check_rows(name: str, rows: list[Any], *, blocks: bool) -> None:
    """Compare the rows of a section of a Gmsh file with what its heads declare."""
    count, declared = int(rows[0][0]), int(rows[0][blocks])
    place, first = 1, []  # node numbers, or the lowest one of each element
    for _ in range(count if blocks else 1):
        held = int(rows[place][3]) if blocks else declared
        start = place + blocks
        for row in rows[start : start + held]:
            if name == "Nodes":
                first.append(int(row[0]))
                continue
            tags = 1 if blocks else 3 + int(row[2])
            kind = int(rows[place][2] if blocks else row[1])
            if len(row) != tags + GMSH_NODES[kind]:
                raise Refused(f"element {int(row[0])} has not the length of its type")
            first.append(min(map(int, row[tags:])))
        place = start + held * (1 + (blocks and name == "Nodes"))  # coordinates follow numbers
    if place != len(rows) or len(first) != declared:
        raise Refused(f"${name} holds more or fewer rows than it declares ({declared})")
    if min(first, default=1) < 1:
        raise Refused(f"${name} holds node {min(first)}, nodes count from 1")
    if name == "Nodes":
        _check_unique(first)


def _binary_rows4(name: str, data: bytes) -> tuple[list[Any], int]:
    """Return the rows of a section of version 4.1 as in text, coordinates empty, and its length."""
    rows: list[Any] = [struct.unpack_from("=4Q", data)]
    place = 32
    for _ in range(rows[0][0]):
        rows.append(struct.unpack_from("=3iQ", data, place))
        kind, count = rows[-1][2:]
        width = 1 if name == "Nodes" else 1 + GMSH_NODES[kind]
        block = np.frombuffer(data[place + 20 : place + 20 + 8 * count * width], "=u8")
        rows += block.reshape(-1, width).tolist()
        place += 20 + 8 * block.size
        if name == "Nodes":
            rows += [()] * count
            place += 24 * count
    return rows, place


def _binary_rows2(name: str, data: bytes) -> tuple[list[Any], int]:
    """Return the rows of a section of version 2 as in text, no coordinates, and its length."""
    place = data.index(b"\n") + 1
    rows: list[Any] = [(int(data[:place]),)]
    if name == "Nodes":
        kind = np.dtype([("number", "=i4"), ("point", "=f8", 3)])
        found = np.frombuffer(data[place : place + 28 * rows[0][0]], kind)
        return [*rows, *found["number"][:, None].tolist()], place + found.nbytes
    while len(rows) <= rows[0][0]:
        kind, count, tags = struct.unpack_from("=3i", data, place)
        width = 1 + tags + GMSH_NODES[kind]
        block = np.frombuffer(data[place + 12 : place + 12 + 4 * count * width], "=i4")
        rows += [[n[0], kind, tags, *n[1:]] for n in block.reshape(-1, width).tolist()]
        place += 12 + block.nbytes
    return rows, place


def read_vtu(path: Path) -> meshio.Mesh:
    """Return the mesh of a .vtu file whose cells have the nodes that its connectivity lists.

    With wrong types or offsets meshio leaves cells out or takes other nodes; of several pieces it
    keeps the cells of the last one.
    """
    reader = _VtuReader(str(path))
    if len(reader.connectivity) != 1:
        raise Refused(f"it holds several pieces ({len(reader.connectivity)}); join them in one")
    nodes = [block.data.ravel() for block in reader.cells if block.type != "wedge"]
    complete = len(nodes) < len(reader.cells)  # meshio reorders wedges
    if not complete and not np.array_equal(np.concatenate(nodes), reader.connectivity[0]):
        raise Refused("the types or the offsets of its cells do not fit their nodes")
    data = reader.point_data, reader.cell_data, reader.field_data
    return meshio.Mesh(reader.points, reader.cells, *data)


class _VtuReader(VtuReader):
    """The reader of meshio that keeps the connectivity as the file lists it."""

    def __init__(self, name: str) -> None:
        self.connectivity: list[np.ndarray] = []
        super().__init__(name)

    def read_data(self, c: Any) -> np.ndarray:
        """Return the values of a DataArray."""
        data = super().read_data(c)
        if c.get("Name") == "connectivity":
            self.connectivity.append(data.ravel())
        return data


def check_counts(path: Path, mesh: meshio.Mesh) -> None:
    """Refuse a mesh with other numbers of nodes or cells than its file declares."""
    _check_unique(getattr(mesh, "points_id", []))  # of Nastran
    cells = sum(len(block.data) for block in mesh.cells)
    values = sum(np.size(block.data) for block in mesh.cells)
    data = path.read_bytes() if path.suffix.lower() in (".vtk", ".su2") else b""
    if not re.search(rb"^CONNECTIVITY\s", data, re.M):  # of VTK 5, else they include the counts
        values += cells
    for held, pattern in (
        (len(mesh.points), rb"^(?:POINTS\s+|\s*NPOIN=\s*)(\d+)"),
        (cells, rb"^(?:CELL_TYPES\s+|\s*NELEM=\s*|\s*MARKER_ELEMS=\s*)(\d+)"),
        (values, rb"^CELLS\s+\d+\s+(\d+)"),
    ):
        declared = [int(count) for count in re.findall(pattern, data, re.M | re.I)]
        if declared and sum(declared) != held:
            raise Refused(f"it declares {sum(declared)} nodes or cells and holds {held}")

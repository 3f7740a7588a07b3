"""Read Abaqus input files: nodes and elements by meshio, sets and surfaces here.

Meshio drops surfaces, sets of `*NODE` and sets of node sets, keeps the last of several sets of a
name, and can give a set of `*ELEMENT` to the elements of another block.

Source: Abaqus Keywords Reference Guide (*ELSET, *NSET, *SURFACE); Abaqus Elements Guide (faces).
"""

import io
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import meshio
import numpy as np
from meshio._common import num_nodes_per_cell
from meshio.abaqus._abaqus import read_buffer

from dpl.fem.mesh.sandbox_checks import Refused

MAKERS = ("NGEN", "NFILL", "NCOPY", "NMAP", "SYSTEM", "ELGEN", "ELCOPY")
FACES = {  # type of the faces of a cell, and the nodes of S1, S2, ...
    "hexahedron": ("quad", ("0123", "4765", "0451", "1562", "2673", "3740")),
    "tetra": ("triangle", ("012", "031", "132", "230")),
    "quad": ("line", ("01", "12", "23", "30")),
    "triangle": ("line", ("01", "12", "20")),
}
KINDS = {"NODE": "NSET", "NSET": "NSET", "ELEMENT": "ELSET", "ELSET": "ELSET"}
Labels = list[int] | None  # of the members of a set; None: it cannot be read
Places = dict[int, tuple[int, int]]  # block and row of each label


class Block(NamedTuple):
    """A keyword with its parameters, and the lines of data that follow."""

    keyword: str
    parameters: dict[str, str]
    lines: list[str]

    @property
    def rows(self) -> list[list[str]]:
        """The entries of each line, without empty ones."""
        rows = ([entry.strip(' "\t') for entry in line.split(",")] for line in self.lines)
        return [list(filter(None, row)) for row in rows]


def read_inp(path: Path) -> meshio.Mesh:
    """Return the mesh of an input file; a set or a surface that cannot be read has no members."""
    blocks = list(_blocks(path.read_text(errors="replace")))
    for block in blocks:
        if block.keyword == "INCLUDE":
            raise Refused("it includes another file; join them in one")
        if block.keyword in MAKERS:
            raise Refused(f"it makes nodes or cells by *{block.keyword}; write them all out")
    instances = [block.lines for block in blocks if block.keyword == "INSTANCE"]
    if len(instances) > 1 or any(instances):
        raise Refused("it moves or repeats a part by *INSTANCE; write a flat input file")
    mesh = read_buffer(io.StringIO("\n".join(_lines_of_mesh(blocks))))
    known: dict[str, Places] = {"NSET": {}, "ELSET": {}}
    sets: dict[str, dict[str, Labels]] = {"NSET": {}, "ELSET": {}}
    for block in blocks:
        if kind := KINDS.get(block.keyword):
            labels = _labels(block, known[kind], sets[kind], mesh)
            if name := block.parameters.get(kind):
                before = sets[kind].get(name, [])
                sets[kind][name] = None if before is None or labels is None else before + labels
        elif block.keyword == "SURFACE" and (name := block.parameters.get("NAME")):
            if block.parameters.get("TYPE", "").upper() == "NODE":
                firsts = block._replace(lines=[line.split(",")[0] for line in block.lines])
                sets["NSET"][name] = _members(firsts, known["NSET"], sets["NSET"])
            elif not _add_faces(mesh, name, block, known["ELSET"], sets["ELSET"]):
                sets["NSET"].setdefault(name, None)
    for name, labels in sets["NSET"].items():
        rows = [known["NSET"][label][1] for label in labels or ()]
        mesh.point_sets[name] = np.array(rows, dtype=int)
    for name, labels in sets["ELSET"].items():
        if labels is None:
            mesh.point_sets.setdefault(name, np.array([], dtype=int))
        places = [known["ELSET"][label] for label in labels or ()]
        members = [[row for b, row in places if b == k] for k in range(len(mesh.cells))]
        mesh.cell_sets[name] = [np.array(rows, dtype=int) for rows in members]
    return mesh


def _blocks(text: str) -> Iterator[Block]:
    """Yield the keywords of a file with their lines of data, without comments."""
    block = Block("", {}, [])
    for line in filter(None, map(str.strip, text.splitlines())):
        if line.startswith("**"):
            continue
        if not line.startswith("*"):
            block.lines.append(line)
            continue
        yield block
        keyword, *options = line[1:].split(",")
        pairs = (option.partition("=")[::2] for option in options)
        parameters = {key.strip().upper(): value.strip(' "\t') for key, value in pairs}
        block = Block(keyword.strip().upper(), parameters, [])
    yield block


def _lines_of_mesh(blocks: list[Block]) -> Iterator[str]:
    """Yield the lines of nodes and elements, without their sets."""
    for block in blocks:
        if block.keyword in ("NODE", "ELEMENT"):
            kind = block.parameters.get("TYPE", "").upper()
            yield from [f"*{block.keyword}" + f",TYPE={kind}" * bool(kind), *block.lines]


def _labels(block: Block, known: Places, sets: Mapping[str, Labels], mesh: meshio.Mesh) -> Labels:
    """Return the labels of the members of a block; those of nodes and elements become known."""
    if block.keyword in ("NSET", "ELSET"):
        return _members(block, known, sets)
    number, width = 0, 0  # of the block among those of its kind; numbers of an element
    if block.keyword == "ELEMENT":
        number = 1 + max((b for b, _ in known.values()), default=-1)
        width = 1 + num_nodes_per_cell[mesh.cells[number].type]
    entries = [entry for row in block.rows for entry in (row if width else row[:1])]
    labels = list(map(int, entries[:: width or 1]))
    known.update({label: (number, row) for row, label in enumerate(labels)})
    return labels


def _members(block: Block, known: Places, sets: Mapping[str, Labels]) -> Labels:
    """Return the labels of a set, a surface or a range; None if one of them is not known."""
    labels: list[int] = []
    for row in block.rows:
        if "GENERATE" in block.parameters:
            first, last, step = [*map(int, row), 1][:3]
            labels += [k for k in known if first <= k <= last and (k - first) % step == 0]
            continue
        for entry in row:
            found = [int(entry)] if entry.isdecimal() else sets.get(entry)
            if found is None or not known.keys() >= set(found):
                return None
            labels += found
    return labels


def _add_faces(
    mesh: meshio.Mesh, name: str, block: Block, known: Places, sets: Mapping[str, Labels]
) -> bool:
    """Add a surface of faces of cells as cells of its own; return False if it cannot be read."""
    faces: dict[str, list[list[int]]] = {}
    for part, side, *_ in (row + 2 * [""] for row in block.rows):
        labels = _members(block._replace(lines=[part]), known, sets)
        if labels is None or not re.fullmatch(r"S[1-6]", side.upper()):
            return False
        for b, row in map(known.__getitem__, labels):
            cells = mesh.cells[b]
            kind, sides = FACES.get(cells.type.rstrip("0123456789"), ("", ()))
            if int(side[1]) > len(sides):
                return False
            nodes = map(int, sides[int(side[1]) - 1])
            faces.setdefault(kind, []).append([int(cells.data[row][node]) for node in nodes])
    mesh.cell_sets[name] = [np.array([], dtype=int) for _ in mesh.cells]
    for kind, rows in faces.items():
        mesh.cells.append(meshio.CellBlock(kind, np.array(rows)))
        mesh.cell_sets[name].append(np.arange(len(rows)))
    return bool(faces)

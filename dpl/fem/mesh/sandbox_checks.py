"""What is refused of mesh files of XML and HDF5 before anything is built of it."""

import contextlib
import re
from pathlib import Path
from typing import Any
from xml.parsers import expat

MOST_BYTES = 4 * 2**30  # of a file [B]
MOST_NODES = 20_000_000
MOST_CELLS = 120_000_000  # tetrahedra are six times as many as nodes
MOST_DEPTH = 50  # of elements in one another; those of meshes are 8 deep
MOST_TEXT = 2**20  # of a file's name or a table of names, in characters
HDF5 = b"\x89HDF\r\n\x1a\n"  # with which such files begin


def vet_count(what: str, count: int, size: int) -> None:
    """Hold a declared count of "nodes", "cells", "nodes of a grid" to what `size` bytes can hold.

    Raises:
        ValueError: It cannot be.
    """
    most = MOST_CELLS if what == "cells" else MOST_NODES
    if not 0 <= count <= most:
        raise ValueError(f"it declares {count} {what}, at most {most} are read; split it")
    if count > size and what != "nodes of a grid":
        raise ValueError(f"it declares {count} {what}, too many for its size; write it anew")


def vet_xml(path: Path) -> None:
    """Refuse what no mesh needs: entities, deep nesting, other files, counts beyond all bounds.

    Raises:
        ValueError: The file is refused. What is no XML is left to the reader.
    """
    try:
        with path.open("rb") as file:
            _Vetting(path).parser.ParseFile(file)
    except expat.ExpatError:
        raw = path.read_bytes()
        start = re.search(rb'<AppendedData[^>]+(?:">)', raw)  # bytes as they are: .vtu has them
        if start:
            end = max(raw.find(b"</AppendedData>"), start.end())
            with contextlib.suppress(expat.ExpatError):
                _Vetting(path).parser.Parse(raw[: start.end()] + raw[end:], True)


class _Vetting:
    """The handlers of a parser; they raise a ValueError for what is refused."""

    def __init__(self, path: Path) -> None:
        self.path, self.size = path, path.stat().st_size
        self.depth = self.pieces = 0
        self.item: dict[str, str] | None = None  # the one whose text counts
        self.text = ""
        self.rows: dict[str, int] = {}  # of .xml: what is declared
        self.places: dict[str, set[str]] = {"nodes": set(), "cells": set()}  # what is listed
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.StartDoctypeDeclHandler = self.parser.EntityDeclHandler = self._entities
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._data

    def _entities(self, *_: Any) -> None:
        raise ValueError("it has a document type or entities, which no mesh needs; remove them")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self.depth += 1
        if self.depth > MOST_DEPTH:
            raise ValueError(f"its elements are nested more than {MOST_DEPTH} deep; write it anew")
        if tag == "DataArray" and attributes.get("Name") == "faces":
            raise ValueError("it holds polyhedra, which cannot be solved; cut them into tetrahedra")
        if tag == "Piece":
            self.pieces += 1
            if self.pieces > 1:
                raise ValueError("it holds several pieces, of which meshio keeps one; join them")
            for name, what in (("NumberOfPoints", "nodes"), ("NumberOfCells", "cells")):
                vet_count(what, _whole(attributes, name), 1000 * self.size)  # zlib packs no better
        elif tag in ("vertices", "cells"):
            what = "nodes" if tag == "vertices" else "cells"
            self.rows[what] = _whole(attributes, "size")
            vet_count(what, self.rows[what], self.size)
        elif tag in ("vertex", "triangle", "tetrahedron"):
            self.places["nodes" if tag == "vertex" else "cells"].add(attributes.get("index", ""))
        elif tag == "Information" or (tag == "DataItem" and attributes.get("Format") != "XML"):
            self.item, self.text = attributes, ""

    def _data(self, text: str) -> None:
        if self.item is not None:
            self.text += text
            if len(self.text) > MOST_TEXT:
                raise ValueError(f"the name of a file in it is longer than {MOST_TEXT} letters")

    def _end(self, tag: str) -> None:
        self.depth -= 1
        if tag == "mesh":
            for what, count in self.rows.items():
                if len(self.places[what]) != count:
                    raise ValueError(
                        f"it declares {count} {what} and holds {len(self.places[what])}"
                    )
        if self.item is None:
            return
        if tag == "Information" and "<!" in self.text:
            self._entities()
        if tag == "DataItem" and self.item.get("Format") in ("HDF", "Binary"):
            self._vet_file(self.text.strip(), self.item["Format"])
        self.item = None

    def _vet_file(self, text: str, kind: str) -> None:
        """Hold a file that this one names to the folder of this one."""
        name = text.rpartition(":")[0] if kind == "HDF" else text
        folder, inner = self.path.resolve().parent, Path(name)
        inside = (folder / inner).resolve().is_relative_to(folder)
        if not name or ":" in name or "\0" in name or inner.is_absolute() or not inside:
            raise ValueError(f"it names {text[:80]!r}, no file in its own folder; copy that there")
        place = folder / inner
        if not place.is_file() or place.stat().st_size > MOST_BYTES:
            raise ValueError(f"it names {text[:80]!r}, no file, or too large; copy that beside it")
        if kind == "HDF":
            vet_hdf5(place)


def _whole(attributes: dict[str, str], name: str) -> int:
    try:
        return int(attributes[name])
    except (KeyError, ValueError):
        return -1


def vet_hdf5(path: Path) -> None:
    """Hold an HDF5 file to its own data: no links to other files, no size that it cannot have."""
    try:
        import h5py
    except ImportError:
        raise ValueError("it is an HDF5 file; install h5py to have it checked and read") from None
    total = 0
    try:
        with h5py.File(path, "r") as file:
            groups, seen = [file], {file.id.__hash__()}
            while groups:
                group = groups.pop()
                for name in group:
                    link = group.get(name, getlink=True)
                    if isinstance(link, h5py.ExternalLink):
                        raise ValueError(f"{name!r} in it is a link to another file; copy its data")
                    if isinstance(link, h5py.SoftLink):
                        continue  # leads to what the walk meets elsewhere
                    item = group[name]
                    if isinstance(item, h5py.Group):
                        place = h5py.h5o.get_info(item.id).addr
                        if place not in seen:
                            seen.add(place)
                            groups.append(item)
                    elif isinstance(item, h5py.Dataset):
                        if item.external or item.is_virtual:
                            raise ValueError(f"{name!r} in it lies in another file; copy its data")
                        total += item.size * item.dtype.itemsize
                    if total > MOST_BYTES:
                        raise ValueError(f"its data would take more than {MOST_BYTES / 2**30} GiB")
    except (OSError, RuntimeError, KeyError) as error:
        raise ValueError(f"it is damaged ({' '.join(str(error).split())[:200]})") from None

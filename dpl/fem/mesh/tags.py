"""Tags of a mesh: named sets of cells and facets, from the sets and fields of a mesh file."""

from collections.abc import Iterator

import meshio
import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.spatial import cKDTree

SIDES = {"line": 2, "triangle": 3, "quad": 4}  # vertices of a facet, which come first
MAX_VALUES = 1000  # distinct values of an integer field that becomes tags

Numbers = NDArray[np.int_]


def add_tags(mesh: skfem.Mesh, raw: meshio.Mesh, kind: str, corners: Numbers) -> skfem.Mesh:
    """Return the mesh with the named sets of its file.

    Its cells are those of type `kind` of the content `raw`, in their order, and its vertices are
    the nodes `corners` (N,) of the file.
    """
    vertex = np.full(len(raw.points), -1)
    vertex[corners] = np.arange(len(corners))
    cells: dict[str, list[Numbers]] = {}
    facets: dict[str, list[Numbers]] = {}
    indices: list[Numbers | None] = []  # of the cells of each block, in the mesh
    known: list[Numbers | None] = []  # of the cells of each block, among the facets
    count, width = 0, len(mesh.facets)
    for block in raw.cells:
        kept = block.type == kind
        _check_indices(f"{block.type} cells", block.data, len(vertex))
        indices.append(count + np.arange(len(block.data)) if kept else None)
        count += len(block.data) if kept else 0
        fits = not kept and SIDES.get(block.type.rstrip("0123456789")) == width
        known.append(_find_facets(mesh, vertex[block.data[:, :width]]) if fits else None)
    for name, b, members in _cell_sets(raw):
        size = len(raw.cells[b].data) if b < len(indices) else 0
        _check_indices(f"the set {name!r}", members, size)
        if (own := indices[b]) is not None:
            cells.setdefault(name, []).append(own[members])
        elif (side := known[b]) is not None:
            found = side[members]
            facets.setdefault(name, []).append(found[found >= 0])
    for field, blocks in raw.cell_data.items():  # of scikit-fem: a bit per facet of each cell
        for b, bits in enumerate(blocks if field.startswith("skfem:b:") else ()):
            if (own := indices[b]) is not None:
                bits = np.asarray(bits).astype(np.int64) >> np.arange(len(mesh.t2f))[:, None] & 1
                local, which = np.nonzero(bits)
                name = field.removeprefix("skfem:b:")
                facets.setdefault(name, []).append(mesh.t2f[local, own[which]])
    for name, inside in _node_sets(raw):
        full = inside[corners][mesh.facets].all(axis=0)
        facets.setdefault(name, []).append(np.flatnonzero(full))
    boundaries, subdomains = (
        {name: np.unique(np.concatenate(parts)).astype(np.int32) for name, parts in found.items()}
        for found in (facets, cells)
    )
    return mesh.with_boundaries(boundaries).with_subdomains(subdomains)


def _find_facets(mesh: skfem.Mesh, sides: Numbers) -> Numbers:
    """Return the facet with the vertices of each side (n, corners), or -1, shape (n,)."""
    # three vertices identify a facet; their numbers are the coordinates of a lattice
    known, wanted = (np.sort(v, axis=1)[:, : mesh.dim()] for v in (mesh.facets.T, sides))
    distance, found = cKDTree(known).query(wanted)
    return np.where(distance == 0, found, -1)


def _cell_sets(raw: meshio.Mesh) -> Iterator[tuple[str, int, Numbers]]:
    """Yield name, block and indices in the block of each named set of cells."""
    for name, blocks in raw.cell_sets.items():
        for b, members in enumerate(blocks):
            if np.size(members):
                yield name, b, np.asarray(members, dtype=np.int64)
    groups = {tuple(key): name for name, key in raw.field_data.items()}
    for field, blocks in raw.cell_data.items():
        saved = field.startswith("skfem:")
        for b, number, members in () if saved else _values(blocks):
            if field != "gmsh:physical":
                yield f"{field}={number}", b, members
            elif number:  # 0: no group
                yield groups.get((number, raw.cells[b].dim), str(number)), b, members
        if field.startswith("skfem:s:") or (not saved and _distinct(blocks) == [0, 1]):
            for b, mask in enumerate(blocks):
                yield field.removeprefix("skfem:s:"), b, np.flatnonzero(mask)


def _node_sets(raw: meshio.Mesh) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield name and mask of each named set of nodes."""
    inside = np.zeros(len(raw.points), dtype=bool)
    sets = [(name, np.asarray(members)) for name, members in raw.point_sets.items()]
    for field, data in raw.point_data.items():
        sets += [(f"{field}={number}", members) for _, number, members in _values([data])]
        sets += [(field, np.flatnonzero(data))] if _distinct([data]) == [0, 1] else []
    for name, members in sets:
        _check_indices(f"the set {name!r}", members, len(inside))
        inside[:] = False
        inside[members] = True
        yield name, inside


def _check_indices(name: str, members: Numbers, count: int) -> None:
    """Raise a ValueError for indices out of range; NumPy would accept negative ones."""
    if np.size(members) and not 0 <= np.min(members) <= np.max(members) < count:
        raise ValueError(
            f"{name[:80]} = {np.min(members)} to {np.max(members)} must be between "
            f"0 and {count - 1}"
        )


def _values(blocks: list) -> Iterator[tuple[int, int, Numbers]]:
    """Yield block, value and indices for each value of a scalar integer field."""
    if 0 < len(_distinct(blocks)) <= MAX_VALUES:
        for b, block in enumerate(map(np.asarray, blocks)):
            for value in np.unique(block):
                yield b, int(value), np.flatnonzero(block == value)


def _distinct(blocks: list) -> list[int]:
    """Return the values of a scalar integer field; none for another field."""
    if not all(np.ndim(b) == 1 and np.asarray(b).dtype.kind in "iub" for b in blocks):
        return []
    return sorted({int(value) for block in blocks for value in np.unique(block)})

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

    Args:
        mesh: The mesh, its cells those of type `kind` in the order of the file.
        raw: The content of the file.
        kind: Type of the cells in meshio.
        corners: Node of the file for each vertex of the mesh, (N,).
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
    for name, b, bits in _saved_facets(raw):
        if (own := indices[b]) is not None:
            local, which = np.nonzero(bits >> np.arange(len(mesh.t2f))[:, None] & 1)
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
        if name and not name.startswith("gmsh:"):
            for b, members in enumerate(blocks):
                if np.size(members):
                    yield name, b, np.asarray(members, dtype=np.int64)
    groups = {tuple(key): name for name, key in raw.field_data.items() if np.size(key) == 2}
    for field, blocks in raw.cell_data.items():
        saved = field.startswith("skfem:")
        for b, number, members in () if saved else _values(blocks):
            if field != "gmsh:physical":
                yield f"{field}={number}", b, members
            elif number:  # 0: no group
                yield groups.get((number, raw.cells[b].dim), str(number)), b, members
        if field.startswith("skfem:s:") or (not saved and _is_mask(blocks)):
            for b, mask in enumerate(blocks):
                yield field.removeprefix("skfem:s:"), b, np.flatnonzero(mask)


def _saved_facets(raw: meshio.Mesh) -> Iterator[tuple[str, int, Numbers]]:
    """Yield name, block and a bit per facet of each cell, as scikit-fem writes sets of facets."""
    for field, blocks in raw.cell_data.items():
        if field.startswith("skfem:b:"):
            for b, bits in enumerate(blocks):
                yield field.removeprefix("skfem:b:"), b, np.asarray(bits).astype(np.int64)


def _node_sets(raw: meshio.Mesh) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield name and mask of each named set of nodes."""
    inside = np.zeros(len(raw.points), dtype=bool)
    sets = [(name, np.asarray(members)) for name, members in raw.point_sets.items()]
    for field, data in raw.point_data.items():
        sets += [(f"{field}={number}", members) for _, number, members in _values([data])]
        sets += [(field, np.flatnonzero(data))] if _is_mask([data]) else []
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
    if not _is_integer(blocks):
        return
    found = [np.unique(block, return_inverse=True) for block in blocks]
    if len({int(v) for values, _ in found for v in values}) > MAX_VALUES:
        return
    for b, (values, which) in enumerate(found):
        order = np.argsort(which, kind="stable")
        ends = np.cumsum(np.bincount(which, minlength=len(values)))[:-1]
        for value, members in zip(values, np.split(order, ends), strict=True):
            yield b, int(value), members


def _is_integer(blocks: list) -> bool:
    return all(np.ndim(block) == 1 and np.asarray(block).dtype.kind in "iub" for block in blocks)


def _is_mask(blocks: list) -> bool:
    return _is_integer(blocks) and {int(v) for block in blocks for v in np.unique(block)} == {0, 1}

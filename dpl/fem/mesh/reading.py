"""Read mesh files, with their named sets of cells and facets."""

import math
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import meshio
import numpy as np
import skfem
from meshio._common import num_nodes_per_cell
from meshio._mesh import topological_dimension
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from skfem.io.meshio import HEX_MAPPING, from_meshio
from skfem.refdom import Refdom, RefHex

from dpl.fem.mesh.sandbox import read
from dpl.fem.mesh.validation import check_coordinates, check_mesh, listed
from dpl.system.checks import named_errors
from dpl.system.memory import refuse_mesh

# supported types of cells in meshio
CELLS = ("hexahedron", "hexahedron27", "tetra", "tetra10", "quad", "quad9", "triangle", "triangle6")
MAX_VALUES = 1000  # distinct values of an integer field that becomes tags
Numbers = NDArray[np.int_]
Array = NDArray[np.float64]


def read_mesh(path: str | Path, scale: float = 1.0) -> skfem.Mesh:
    """Return the mesh of a file, validated by `check_mesh`.

    The cells of the highest dimension are kept in their order, those of inverted node order are
    reordered, nodes without a cell are dropped, and a mesh of constant z becomes a 2D mesh.

    Named parts become scikit-fem's `mesh.boundaries` (facets) and `mesh.subdomains` (cells), whose
    names are regions, see `dpl.fem.Tag`:

    - physical groups of Gmsh, by name, or by number ("7") if they have no name;
    - sets of cells or nodes (.inp and others) and surfaces of Abaqus, by name;
    - integer fields on cells or nodes, as "field=value"; if the values are 0 and 1, also as
      "field" for the ones.

    A set of nodes becomes the facets, also interior ones, whose vertices all belong to it. Groups
    of points and, in 3D, of curves are dropped.

    Args:
        path: A file in a format of meshio that needs no further files (.msh, .vtu, .vtk, .inp,
            ...). The file need not be trusted, see `dpl.fem.mesh.sandbox`.
        scale: Unit of its coordinates [m]: 1e-3 for millimetres.

    Errors number nodes as the file lists them, from 0, and cells in the same way among those that
    are kept. A warning says which nodes are dropped, which cells are reordered and which sets
    cannot be read; regions of their names are refused.
    """
    path = Path(path)
    if not 0 < scale < math.inf:
        raise ValueError(f"scale = {scale} must be a number above 0, the unit of the file [m]")
    raw = read(path)
    with named_errors(f"{path}: "):
        mesh, repairs = to_mesh(raw)
    if repairs:
        warnings.warn(f"{path}: {'; '.join(repairs)}", stacklevel=2)
    return mesh if scale == 1 else mesh.scaled(scale)


def read_cell_data(path: str | Path, names: Sequence[str]) -> list[Array]:
    """Return named fields on the cells of a mesh file, (E,) or (E, components) each.

    Their rows are those of the cells of `read_mesh`, in this order.

    Args:
        path: The file, which need not be trusted, see `dpl.fem.mesh.sandbox`.
        names: Names of the fields.
    """
    raw, fields = read(Path(path)), []
    with named_errors(f"{path}: "):
        kind = _cell_type(raw)
        cells = sum(len(block.data) for block in raw.cells if block.type == kind)
        for name in names:
            if name not in raw.cell_data:
                known = ", ".join(map(repr, sorted(raw.cell_data)[:20])) or "none"
                raise ValueError(f"has no cell data {name!r}; there are: {known}")
            parts = [
                np.asarray(values, dtype=np.float64)
                for block, values in zip(raw.cells, raw.cell_data[name], strict=False)
                if block.type == kind
            ]
            if len({part.shape[1:] for part in parts}) != 1 or sum(map(len, parts)) != cells:
                raise ValueError(f"cell data {name!r} must have one row for each of {cells} cells")
            fields.append(np.concatenate(parts))
    return fields


def to_mesh(raw: meshio.Mesh) -> tuple[skfem.Mesh, list[str]]:
    """Return the validated mesh of the content of a file, and a clause for each repair."""
    kind = _cell_type(raw)
    dim = topological_dimension[kind]
    points = np.asarray(raw.points, dtype=np.float64)
    if points.ndim != 2:
        raise ValueError("lists nodes with too few coordinates; does it end too early?")
    if points.shape[1] < dim:
        raise ValueError(f"nodes of {kind} cells must have {dim} coordinates")
    cells = np.concatenate([block.data for block in raw.cells if block.type == kind])
    if cells.dtype.kind not in "iu":
        raise ValueError("cell connectivity must contain integers")
    cells, nodes = cells.astype(np.int64), len(points)
    low, high = cells.min(), cells.max()
    if low < 0 or high >= nodes:
        guess = "; does the numbering start at 1?" if (low, high) == (1, nodes) else ""
        bad = np.flatnonzero(((cells < 0) | (cells >= nodes)).any(axis=1))
        raise ValueError(
            f"node numbers of cells = {low} to {high} must be between 0 and {nodes - 1}{guess} "
            f"({len(bad)} such cells: {listed(bad)})"
        )
    used, compact = np.unique(cells, return_inverse=True)
    refuse_mesh(len(used), "its size")
    compact, unused = compact.reshape(cells.shape), nodes - len(used)
    points = points[used]
    check_coordinates(points, used)
    if dim == 2:
        away = points[:, 2:] - points[0, 2:]
        bad = np.flatnonzero((np.abs(away) > 1e-9 * np.ptp(points, axis=0).max()).any(axis=1))
        if len(bad):
            raise ValueError(
                "is a surface mesh embedded in 3D; a 2D mesh must have constant z "
                f"({len(bad)} nodes do not: {listed(used[bad])})"
            )
        points = points[:, :2]
    mesh = from_meshio(meshio.Mesh(points, [(kind, compact)]))
    corners = np.unique(cells[:, : len(mesh.t)])  # vertex k is node corners[k] of the file
    mesh = _add_tags(check_mesh(mesh, numbers=corners), raw, kind, corners)
    repairs = _repairs(mesh.elem.refdom, points[compact], unused)
    if lost := [repr(name) for name, members in raw.point_sets.items() if not np.size(members)]:
        repairs.append(f"sets without members or that cannot be read: {', '.join(lost)}")
    return mesh, repairs


def _cell_type(raw: meshio.Mesh) -> str:
    """Return the type in meshio of the cells of the highest dimension."""
    blocks = [block for block in raw.cells if len(block.data)]
    dim = max((block.dim for block in blocks), default=0)
    kinds = sorted({block.type for block in blocks if block.dim == dim})
    if len(kinds) != 1 or kinds[0] not in CELLS:
        names = " and ".join(kinds) or "no"
        raise ValueError(f"holds {names} cells; convert them to one type: {', '.join(CELLS)}")
    for block in raw.cells:
        width = num_nodes_per_cell[kinds[0]] if block.type == kinds[0] else None
        if np.ndim(block.data) != 2 or width not in (None, block.data.shape[1]):
            raise ValueError("lists cells with too few nodes; does it end too early?")
    return kinds[0]


def _repairs(shape: type[Refdom], nodes: Array, unused: int) -> list[str]:
    """Return a clause for each repair of cells with nodes at (E, A, D) in VTK order."""
    # scikit-fem's axes of a hexahedron are those of VTK in reverse
    corners = shape.p.T[HEX_MAPPING[:8], ::-1] if shape is RefHex else shape.p.T
    # Jacobian at the centre of a cell: least-squares fit to its vertices
    fit = np.linalg.pinv(corners - corners.mean(axis=0))
    J = fit @ nodes[:, : len(corners)]  # (E, D, D)
    repairs = []
    backwards = int((np.linalg.det(J) < 0).sum())
    plane = len(fit) == 2  # may be seen from either side
    if backwards and not (plane and backwards == len(J)):
        how = "list their nodes clockwise, unlike the others" if plane else "are inverted"
        repairs.append(f"{backwards} of {len(J)} cells {how}; their nodes are reordered")
    if unused:
        repairs.append(f"{unused} nodes belong to no cell; they are dropped")
    return repairs


def _add_tags(mesh: skfem.Mesh, raw: meshio.Mesh, kind: str, corners: Numbers) -> skfem.Mesh:
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
        # of facets of quadratic cells, the vertices come first
        fits = not kept and num_nodes_per_cell.get(block.type.rstrip("0123456789")) == width
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

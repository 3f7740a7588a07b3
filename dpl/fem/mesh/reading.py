"""Mesh files read, with the names that they give to parts of the body."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import skfem
from numpy.typing import NDArray
from skfem.io.meshio import from_meshio

from dpl.fem.mesh.sandbox import read
from dpl.fem.mesh.validation import LARGEST, check_mesh, listed
from dpl.system.memory import refuse_mesh

CELLS = {  # meshio's names of what can be solved, best first: dimension, nodes
    "hexahedron": (3, 8),
    "hexahedron27": (3, 27),
    "tetra": (3, 4),
    "tetra10": (3, 10),
    "quad": (2, 4),
    "quad9": (2, 9),
    "triangle": (2, 3),
    "triangle6": (2, 6),
}
SIDES = {  # of these cells: corners, which meshio lists first
    "line": 2,
    "line3": 2,
    "triangle": 3,
    "triangle6": 3,
    "triangle7": 3,
    "quad": 4,
    "quad8": 4,
    "quad9": 4,
}
CORNERS: dict[str, Any] = {  # of the reference cells, in the order of files
    "hexahedron": [
        (0, 0, 0),
        (1, 0, 0),
        (1, 1, 0),
        (0, 1, 0),
        (0, 0, 1),
        (1, 0, 1),
        (1, 1, 1),
        (0, 1, 1),
    ],
    "tetra": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
    "quad": [(0, 0), (1, 0), (1, 1), (0, 1)],
    "triangle": [(0, 0), (1, 0), (0, 1)],
}
MOST_VALUES = 1000  # of a field that tells parts apart; with more it counts something else

Numbers = NDArray[np.int_]
Array = NDArray[np.float64]


def read_mesh(path: str | Path) -> skfem.Mesh:
    """Return the mesh of any file that meshio reads, checked.

    The cells of the highest dimension are kept in their order, nodes that no cell uses are dropped,
    and a planar mesh with a third coordinate of zero becomes a 2D one. Cells may list their nodes
    inside out: they are read as if they did not. Those of a plane body may all be clockwise.

    The file's names for parts are kept as scikit-fem's `mesh.boundaries` (facets) and
    `mesh.subdomains` (cells), where `dpl.fem.Tag` finds them:

    - Gmsh's physical groups, by name; by number ("7") if they have none;
    - sets of cells or nodes (.inp and others), by name;
    - whole-numbered fields on cells or nodes, as "field=value"; where such a field is only 0 or 1,
      "field" stands for the ones too.

    Sets of nodes become the facets that have all their vertices in it, inner ones too. Groups of
    single points or, in 3D, of curves are not kept.

    Args:
        path: A file (.msh, .vtu, .vtk, .inp, ...), coordinates in metres. It need not be trusted:
            `dpl.fem.mesh.sandbox` says what is refused.

    Raises:
        FileNotFoundError: There is no such file.
        MemoryError: So many nodes do not fit.
        ValueError: The file cannot be read, or its mesh cannot be solved; the message says why.
            Nodes have the place in which the file lists them, from 0; so have cells among those
            that are kept.

    Warns:
        UserWarning: Nodes are dropped, or cells are listed inside out; the message says how many.
    """
    path = Path(path)
    raw = read(path)
    try:
        mesh, repairs = _body(raw)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if repairs:
        warnings.warn(f"{path}: {'; '.join(repairs)}", stacklevel=2)
    return mesh


def _body(raw: meshio.Mesh) -> tuple[skfem.Mesh, list[str]]:
    """Return the mesh, checked, and what was corrected, a clause each."""
    found = {block.type for block in raw.cells if len(block.data)}
    kinds = [kind for kind in CELLS if kind in found]
    if not kinds:
        raise ValueError(
            f"holds no cells that can be solved ({', '.join(sorted(found)) or 'none'})"
        )
    dim = max(block.dim for block in raw.cells if len(block.data))
    kinds = sorted({block.type for block in raw.cells if block.dim == dim and len(block.data)})
    if len(kinds) > 1 or kinds[0] not in CELLS:
        what = f"mixes {' and '.join(kinds)} cells" if len(kinds) > 1 else f"holds {kinds[0]} cells"
        raise ValueError(f"{what}; convert them to one kind: {', '.join(CELLS)}")
    wide = {kinds[0]: CELLS[kinds[0]][1]}
    for block in raw.cells:
        shape = np.shape(block.data)
        if len(shape) != 2 or shape[1] != wide.get(block.type, shape[1]):
            raise ValueError("lists cells with too few nodes; does it end too early?")
    points = np.asarray(raw.points, dtype=np.float64)
    if points.ndim != 2:
        raise ValueError("lists nodes with too few coordinates; does it end too early?")
    cells = np.concatenate([block.data for block in raw.cells if block.type == kinds[0]])
    if cells.dtype.kind not in "iu":
        raise ValueError("numbers the nodes of cells by what are no whole numbers")
    cells = cells.astype(np.int64)
    if points.shape[1] < dim:
        raise ValueError(f"{kinds[0]} cells need nodes of {dim} coordinates")
    _check_range(cells, len(points))
    used, compact = np.unique(cells, return_inverse=True)
    refuse_mesh(len(used), "its size")
    compact = compact.reshape(-1, CELLS[kinds[0]][1])
    points = _flat(points, used) if dim == 2 else points[used]
    mesh = from_meshio(meshio.Mesh(points, [(kinds[0], compact)]))
    corners = np.unique(cells[:, : len(mesh.t)])  # vertex k is node corners[k] of the file
    mesh = _tagged(check_mesh(mesh, numbers=corners), raw, kinds[0], corners)
    return mesh, _repairs(kinds[0], points[compact], len(raw.points) - len(used))


def _repairs(kind: str, nodes: Array, unused: int) -> list[str]:
    """Return what is corrected of cells with nodes at (E, A, D), a clause each."""
    corners = np.array(CORNERS[kind.rstrip("0123456789")], dtype=np.float64)
    # the Jacobian in the middle of a cell: the linear map that fits its corners best
    fit = np.linalg.pinv(corners - corners.mean(axis=0))
    J = fit @ nodes[:, : len(corners)]  # (E, D, D)
    repairs = []
    backwards = int((np.linalg.det(J) < 0).sum())
    plane = len(fit) == 2  # which may be seen from either side
    if backwards and not (plane and backwards == len(J)):
        how = "clockwise, unlike the others," if plane else "inside out"
        repairs.append(
            f"{backwards} of {len(J)} cells list their nodes {how} and are read the other way round"
        )
    if unused:
        repairs.append(f"{unused} nodes are used by no cell and are left out")
    return repairs


def _check_range(cells: Numbers, nodes: int) -> None:
    low, high = cells.min(), cells.max()
    if low < 0 or high >= nodes:
        guess = "; does the numbering start at 1?" if (low, high) == (1, nodes) else ""
        bad = np.flatnonzero(((cells < 0) | (cells >= nodes)).any(axis=1))
        raise ValueError(
            f"cells name nodes {low} to {high}, there are 0 to {nodes - 1}{guess} "
            f"({len(bad)} such cells: {listed(bad)})"
        )


def _flat(points: NDArray[np.float64], used: Numbers) -> NDArray[np.float64]:
    """Return the used points without their third coordinate, if it is zero.

    Raises:
        ValueError: It is not, at a node that is named.
    """
    points = points[used]
    if points.shape[1] == 3:
        bad = np.flatnonzero(~(np.abs(points[:, 2]) <= LARGEST))
        if len(bad):  # which the comparison with their distances would let pass
            raise ValueError(
                f"coordinates of {len(bad)} nodes are not finite or beyond {LARGEST:.0e} m: "
                + listed(used[bad])
            )
        away = np.abs(points[:, 2] - points[0, 2])
        bad = np.flatnonzero(away > 1e-9 * np.ptp(points, axis=0).max())
        if len(bad):
            raise ValueError(
                "is a surface in space, no body; a 2D mesh must lie in the plane z = 0 "
                f"({len(bad)} nodes leave it: {listed(used[bad])})"
            )
    return points[:, :2]


def _tagged(mesh: skfem.Mesh, raw: meshio.Mesh, kind: str, corners: Numbers) -> skfem.Mesh:
    """Return the mesh with the names of the file; vertex k is node corners[k] of it."""
    vertex = np.full(len(raw.points), -1)
    vertex[corners] = np.arange(len(corners))
    cells: dict[str, list[Numbers]] = {}
    facets: dict[str, list[Numbers]] = {}
    places: list[Numbers | None] = []  # of each block's cells among those of the mesh
    known: list[Numbers | None] = []  # of each block's cells among the facets of the mesh
    count, width = 0, len(mesh.facets)
    for block in raw.cells:
        kept = block.type == kind
        _within(f"{block.type} cells", block.data, len(vertex))
        places.append(count + np.arange(len(block.data)) if kept else None)
        count += len(block.data) if kept else 0
        fits = not kept and SIDES.get(block.type) == width
        known.append(_find(mesh, vertex[block.data[:, :width]]) if fits else None)
    for name, b, members in _cell_sets(raw):
        _within(f"the set {name!r}", members, len(raw.cells[b].data) if b < len(places) else 0)
        if (own := places[b]) is not None:
            cells.setdefault(name, []).append(own[members])
        elif (side := known[b]) is not None:
            found = side[members]
            facets.setdefault(name, []).append(found[found >= 0])
    for name, b, bits in _saved_facets(raw):
        if (own := places[b]) is not None:
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


def _find(mesh: skfem.Mesh, sides: Numbers) -> Numbers:
    """Return which facet of the mesh has the vertices of each side (n, corners), or -1."""
    both = np.sort(np.concatenate([mesh.facets.T, sides]), axis=1)
    both = both[:, : mesh.dim()]  # three corners tell faces apart
    order = np.lexsort(both.T)  # stable: a facet comes before the sides that are like it
    new = np.ones(len(both), dtype=bool)
    new[1:] = (np.diff(both[order], axis=0) != 0).any(axis=1)
    first = order[new][np.cumsum(new) - 1]
    found = np.empty(len(both), dtype=np.int64)
    found[order] = np.where(first < mesh.facets.shape[1], first, -1)
    return found[mesh.facets.shape[1] :]


def _cell_sets(raw: meshio.Mesh) -> Iterator[tuple[str, int, Numbers]]:
    """Yield all named sets of cells: name, block, places in the block."""
    for name, blocks in raw.cell_sets.items():
        if name and not name.startswith("gmsh:"):
            for b, members in enumerate(blocks):
                if np.size(members):
                    yield name, b, np.asarray(members, dtype=np.int64)
    groups = {tuple(key): name for name, key in raw.field_data.items() if np.size(key) == 2}
    for field, blocks in raw.cell_data.items():
        if field.startswith("skfem:"):
            if field.startswith("skfem:s:"):
                for b, mask in enumerate(blocks):
                    yield field.removeprefix("skfem:s:"), b, np.flatnonzero(mask)
            continue
        for b, number, members in _values(blocks):
            if field != "gmsh:physical":
                yield f"{field}={number}", b, members
            elif number:  # 0 stands for none
                yield groups.get((number, raw.cells[b].dim), str(number)), b, members
        if _is_mask(blocks):
            for b, mask in enumerate(blocks):
                yield field, b, np.flatnonzero(mask)


def _saved_facets(raw: meshio.Mesh) -> Iterator[tuple[str, int, Numbers]]:
    """Yield sets of facets as scikit-fem writes them: name, block, a bit per side of each cell."""
    for field, blocks in raw.cell_data.items():
        if field.startswith("skfem:b:"):
            for b, bits in enumerate(blocks):
                yield field.removeprefix("skfem:b:"), b, np.asarray(bits).astype(np.int64)


def _node_sets(raw: meshio.Mesh) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield all named sets of nodes: name, which nodes."""
    inside = np.zeros(len(raw.points), dtype=bool)
    sets = [(name, np.asarray(members)) for name, members in raw.point_sets.items()]
    for field, data in raw.point_data.items():
        sets += [(f"{field}={number}", members) for _, number, members in _values([data])]
        sets += [(field, np.flatnonzero(data))] if _is_mask([data]) else []
    for name, members in sets:
        _within(f"the set {name!r}", members, len(inside))
        inside[:] = False
        inside[members] = True
        yield name, inside


def _within(name: str, members: Numbers, count: int) -> None:
    """Hold numbers to those that there are, for NumPy takes negative ones too."""
    if np.size(members) and not 0 <= np.min(members) <= np.max(members) < count:
        raise ValueError(
            f"{name[:80]} name {np.min(members)} to {np.max(members)}, there are 0 to {count - 1}"
        )


def _values(blocks: list) -> Iterator[tuple[int, int, Numbers]]:
    """Yield block, value, places for each value of a whole-numbered field of one component."""
    if not _is_whole(blocks):
        return
    found = [np.unique(block, return_inverse=True) for block in blocks]
    if len({int(v) for values, _ in found for v in values}) > MOST_VALUES:
        return
    for b, (values, which) in enumerate(found):
        order = np.argsort(which, kind="stable")
        ends = np.cumsum(np.bincount(which, minlength=len(values)))[:-1]
        for value, members in zip(values, np.split(order, ends), strict=True):
            yield b, int(value), members


def _is_whole(blocks: list) -> bool:
    return all(np.ndim(block) == 1 and np.asarray(block).dtype.kind in "iub" for block in blocks)


def _is_mask(blocks: list) -> bool:
    return _is_whole(blocks) and {int(v) for block in blocks for v in np.unique(block)} == {0, 1}

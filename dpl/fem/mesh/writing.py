"""Bodies and what was solved on them, written as mesh files for other programs."""

import contextlib
import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import meshio
import numpy as np
import skfem
from meshio.xdmf import TimeSeriesWriter
from numpy.typing import NDArray
from skfem.io.meshio import to_meshio

MIRRORED = {  # nodes of a tetrahedron whose first two corners change places
    "tetra": [1, 0, 2, 3],
    "tetra10": [1, 0, 2, 3, 4, 6, 5, 8, 7, 9],
}
Numbers = NDArray[np.int_]
Array = NDArray[np.float64]


def flat_cells(mesh: skfem.Mesh, nodes: int) -> tuple[str, Numbers]:
    """Return the cells of a body as files list them: meshio's name, nodes in VTK's order (E, A).

    Tetrahedra are right-handed, as scikit-fem's need not be.

    Args:
        mesh: The body.
        nodes: Of its fields: those of the mesh, or of quadratic cells on it.

    Raises:
        ValueError: It is neither.
    """
    if nodes != mesh.p.shape[1]:
        mesh = _quadratic(mesh)
    if nodes != mesh.p.shape[1]:
        raise ValueError(f"fields at {nodes} nodes are of another body")
    (block,) = to_meshio(mesh, encode_cell_data=False).cells
    left, cells = _left(mesh), block.data.copy()
    if left.any():
        cells[left] = cells[left][:, MIRRORED[block.type]]
    return block.type, cells


def _left(mesh: skfem.Mesh) -> NDArray[np.bool_]:
    """Return which cells are left-handed tetrahedra, (E,)."""
    if mesh.elem.refdom.name != "Tetrahedral":
        return np.zeros(mesh.nelements, dtype=bool)
    corners = mesh.p.T[mesh.t[:4].T]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0


def _tags(mesh: skfem.Mesh) -> dict[str, list[Array]]:
    """Return the tags of a body as data of its cells, facets numbered as by `flat_cells`.

    Sets of facets are a bit for each side of each cell. Where the first two corners of a
    tetrahedron change places its last two sides do.
    """
    tags: dict[str, list[Array]] = to_meshio(mesh).cell_data
    for name, (bits,) in tags.items():
        if name.startswith("skfem:b:"):
            whole = np.asarray(bits).astype(np.int64)
            change = (whole >> 3 ^ whole >> 2) & _left(mesh)
            tags[name] = [(whole ^ (change << 3 | change << 2)).astype(bits.dtype)]
    return tags


def _quadratic(mesh: skfem.Mesh) -> skfem.Mesh:
    """Return a mesh with the nodes of quadratic cells, numbered as `Problem` numbers them."""
    kinds: dict[type[skfem.Mesh], type[skfem.Mesh]] = {
        skfem.MeshTri1: skfem.MeshTri2,
        skfem.MeshQuad1: skfem.MeshQuad2,
        skfem.MeshTet1: skfem.MeshTet2,
        skfem.MeshHex1: skfem.MeshHex2,
    }
    kind = kinds.get(type(mesh))
    return mesh if kind is None else kind.from_mesh(mesh)


def _written(mesh: skfem.Mesh, fields: Mapping[str, Array]) -> meshio.Mesh:
    """Return a body with its fields as meshio writes them, see `write_mesh`."""
    counts = {len(field) for field in fields.values()} or {mesh.p.shape[1]}
    if len(counts) > 1:
        raise ValueError(f"fields at {', '.join(map(str, sorted(counts)))} nodes: of one body each")
    (nodes,) = counts
    kind, cells = flat_cells(mesh, nodes)
    whole = mesh if nodes == mesh.p.shape[1] else _quadratic(mesh)
    data = {name: _spatial(field) for name, field in fields.items()}
    return meshio.Mesh(_spatial(whole.p.T), [(kind, cells)], point_data=data, cell_data=_tags(mesh))


def _spatial(field: Array) -> Array:
    """Return a field with three components, tensors (N, 3, 3) with nine."""
    if field.ndim == 3:
        return field.reshape(len(field), -1)
    return field if field.ndim == 1 else np.pad(field, ((0, 0), (0, 3 - field.shape[1])))


def write_mesh(path: Path, mesh: skfem.Mesh, fields: Mapping[str, Array]) -> None:
    """Write a mesh, its tags and fields at its nodes, in any format of meshio.

    Args:
        path: A file; its folder is made if there is none. Tags need cell data (.vtu, .vtk).
        mesh: The body.
        fields: By name, (N,), (N, D) or (N, 3, 3). Where N is that of quadratic cells on the mesh
            (`Problem.points` of degree 2), cells are written quadratic.

    Raises:
        ValueError: N is of another body, or not the same for all.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    meshio.write(path, _written(mesh, fields))


def write_mesh_exactly(path: Path, mesh: skfem.Mesh) -> None:
    """Write a mesh and its tags as VTU, so that `load` returns it to the last bit.

    Cells keep the sense in which they list their nodes, which `write_mesh` does not promise.

    Args:
        path: A file, of any name.
        mesh: The body [m].
    """
    exact = to_meshio(mesh)
    exact.points = _spatial(exact.points)
    exact.cell_data = {_quoted(name): data for name, data in exact.cell_data.items()}
    meshio.write(path, exact, file_format="vtu")


def _quoted(name: str) -> str:
    """Return a name as an attribute of XML in ASCII, which meshio leaves to its callers."""
    marks = {mark: f"&#{ord(mark)};" for mark in '"\t\n\r'}
    return escape(name, marks).encode("ascii", "xmlcharrefreplace").decode()


def write_series(path: Path, mesh: skfem.Mesh, steps: Sequence[Mapping[str, Array]]) -> list[Path]:
    """Write the same fields of several loads for ParaView, the number of the load as its time.

    A VTU file for each beside `NAME.pvd`, which opens them as one, and all in `NAME.xdmf`: numbers
    in `NAME.h5` where h5py is installed, else inside.

    Args:
        path: Folder and NAME; the folder is made if there is none.
        mesh: The body.
        steps: Fields of each load, see `write_mesh`.

    Returns:
        The files to open: collection and XDMF.
    """
    names = [f"{path.name}_{k:03d}.vtu" for k in range(len(steps))]
    bodies = [_written(mesh, fields) for fields in steps]
    path.parent.mkdir(parents=True, exist_ok=True)
    for name, body in zip(names, bodies, strict=True):
        meshio.write(path.with_name(name), body)
    collection, series = path.with_name(f"{path.name}.pvd"), path.with_name(f"{path.name}.xdmf")
    write_collection(collection, list(enumerate(names)))
    kept = "HDF" if importlib.util.find_spec("h5py") else "XML"
    with contextlib.chdir(path.parent), TimeSeriesWriter(series.name, data_format=kept) as file:
        file.write_points_cells(bodies[0].points, bodies[0].cells)
        for k, body in enumerate(bodies):
            file.write_data(k, point_data=body.point_data)
    return [collection, series]


def write_collection(path: Path, files: Sequence[tuple[float, str]]) -> None:
    """Write a PVD file, which opens VTU files as a series in ParaView.

    Args:
        path: Of the PVD file.
        files: Time of each, and its name from the folder of `path`.
    """
    lines = [f'<DataSet timestep="{time:.6g}" file={quoteattr(name)}/>' for time, name in files]
    head = '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">'
    rows = ['<?xml version="1.0"?>', head, "<Collection>", *lines, "</Collection>", "</VTKFile>"]
    path.write_text("\n".join(rows) + "\n")

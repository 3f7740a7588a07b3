"""Write meshes and nodal fields to files."""

import contextlib
import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import meshio
import numpy as np
import skfem
from meshio._vtk_common import meshio_to_vtk_type
from meshio.xdmf import TimeSeriesWriter
from numpy.typing import NDArray
from skfem.io.meshio import to_meshio

from dpl.fem.mesh.regions import group_names

Array = NDArray[np.float64]


def with_nodes(mesh: skfem.Mesh, nodes: int) -> skfem.Mesh:
    """Return a mesh with right-handed tetrahedra whose number of nodes is `nodes`.

    Its cells are quadratic, as in `Problem`, if the given mesh has another number of nodes.
    """
    name = type(mesh).__name__
    if nodes != mesh.p.shape[1] and name.endswith("1"):
        facets, cells = mesh.boundaries or {}, mesh.subdomains or {}
        mesh = getattr(skfem, f"{name[:-1]}2").from_mesh(mesh)
        mesh = mesh.with_boundaries(facets).with_subdomains(cells)
    if nodes != mesh.p.shape[1]:
        raise ValueError(
            f"fields = arrays of {nodes} nodes must have those of the mesh ({mesh.p.shape[1]})"
        )
    return mesh.oriented() if mesh.elem.refdom.name == "Tetrahedral" else mesh


def _to_meshio(mesh: skfem.Mesh, fields: Mapping[str, Array]) -> meshio.Mesh:
    """Return a mesh of meshio with nodal fields; arguments as in `write_mesh`."""
    nodes, *others = sorted({len(field) for field in fields.values()} or {mesh.p.shape[1]})
    if others:
        counts = ", ".join(map(str, [nodes, *others]))
        raise ValueError(f"fields = arrays of {counts} nodes must be equally long")
    shown, body = group_names(mesh), to_meshio(with_nodes(mesh, nodes))
    body.points = _spatial(body.points)
    body.point_data = {name: _spatial(field) for name, field in fields.items()}
    tags = body.cell_data.items()
    body.cell_data = {key: bits for key, bits in tags if key.split(":", 2)[-1] in shown}
    return body


def _spatial(field: Array) -> Array:
    """Return a vector field padded to three components, and a tensor field (N, 3, 3) as (N, 9)."""
    if field.ndim == 3:
        return field.reshape(len(field), -1)
    return field if field.ndim == 1 else np.pad(field, ((0, 0), (0, 3 - field.shape[1])))


def write_mesh(path: Path, mesh: skfem.Mesh, fields: Mapping[str, Array]) -> None:
    """Write a mesh, its tags and nodal fields in a format of meshio.

    Args:
        path: File; its suffix selects the format, and its folder is created. Tags need a format
            with cell data (.vtu, .vtk).
        mesh: The body [m].
        fields: Arrays (N,), (N, D) or (N, 3, 3) by name. If N is the number of nodes of quadratic
            cells (`Problem.points` of degree 2), quadratic cells are written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    meshio.write(path, _to_meshio(mesh, fields))


def write_mesh_exactly(
    path: Path, mesh: skfem.Mesh, cell_data: Mapping[str, Array] | None = None
) -> None:
    """Write a mesh [m], its tags and arrays (E, ...) by name as VTU, to be read with the same bits.

    Unlike `write_mesh` it does not reorder the nodes of cells, and the file may have any name.
    """
    exact = to_meshio(mesh)
    exact.cell_data |= {name: [np.asarray(rows)] for name, rows in (cell_data or {}).items()}
    exact.points = _spatial(exact.points)
    marks = {mark: f"&#{ord(mark)};" for mark in '"\t\n\r'}
    exact.cell_data = {  # meshio does not escape names
        escape(name, marks).encode("ascii", "xmlcharrefreplace").decode(): data
        for name, data in exact.cell_data.items()
    }
    meshio.write(path, exact, file_format="vtu")


def write_series(path: Path, mesh: skfem.Mesh, steps: Sequence[Mapping[str, Array]]) -> list[Path]:
    """Write the fields of several loads as a time series for ParaView.

    Writes one VTU file per load, their collection `NAME.pvd`, and `NAME.xdmf` with all loads. If
    h5py is installed, `NAME.vtkhdf` has all loads too, and the numbers of `NAME.xdmf` are in
    `NAME.h5`. The time is the index of the load. Returns the paths of the PVD, XDMF and VTKHDF
    files.

    Args:
        path: Folder and NAME; the folder is created.
        mesh: The body [m].
        steps: Fields of each load as in `write_mesh`.
    """
    names = [f"{path.name}_{k:03d}.vtu" for k in range(len(steps))]
    bodies = [_to_meshio(mesh, fields) for fields in steps]
    path.parent.mkdir(parents=True, exist_ok=True)
    for name, body in zip(names, bodies, strict=True):
        meshio.write(path.with_name(name), body)
    collection, series = path.with_name(f"{path.name}.pvd"), path.with_name(f"{path.name}.xdmf")
    write_collection(collection, list(enumerate(names)))
    hdf = importlib.util.find_spec("h5py") is not None
    kept = "HDF" if hdf else "XML"
    with contextlib.chdir(path.parent), TimeSeriesWriter(series.name, data_format=kept) as file:
        file.write_points_cells(bodies[0].points, bodies[0].cells)
        for k, body in enumerate(bodies):
            file.write_data(k, point_data=body.point_data)
    return [collection, series, *([_write_vtkhdf(path, bodies)] if hdf else [])]


def _write_vtkhdf(path: Path, bodies: Sequence[meshio.Mesh]) -> Path:
    """Write bodies that differ in their nodal fields as VTKHDF 2.0; return the path of the file.

    The format is specified in the documentation of VTK, "VTKHDF File Format". Points, cells and
    cell data are stored once, so their offsets are 0 in all steps. A name in HDF5 has no "/".
    """
    import h5py

    body, steps = bodies[0], len(bodies)
    (block,), once = body.cells, np.zeros(steps, dtype=np.int64)
    tree = {
        "NumberOfPoints": [len(body.points)],
        "NumberOfCells": [len(block.data)],
        "NumberOfConnectivityIds": [block.data.size],
        "Points": body.points,
        "Connectivity": block.data.ravel(),
        "Offsets": np.arange(len(block.data) + 1) * block.data.shape[1],
        "Types": np.full(len(block.data), meshio_to_vtk_type[block.type], dtype=np.uint8),
        "Steps/Values": np.arange(steps, dtype=np.float64),
        "Steps/NumberOfParts": once + 1,
        "Steps/PartOffsets": once,
        "Steps/PointOffsets": once,
        "Steps/CellOffsets": once[:, None],
        "Steps/ConnectivityIdOffsets": once[:, None],
    }
    for name in body.point_data:
        key = name.replace("/", " per ")
        tree[f"PointData/{key}"] = np.concatenate([one.point_data[name] for one in bodies])
        tree[f"Steps/PointDataOffsets/{key}"] = np.arange(steps) * len(body.points)
    for name, (column,) in body.cell_data.items():
        key = name.replace("/", " per ")
        tree[f"CellData/{key}"], tree[f"Steps/CellDataOffsets/{key}"] = column, once
    file = path.with_name(f"{path.name}.vtkhdf")
    with h5py.File(file, "w") as root:
        group = root.create_group("VTKHDF")
        group.attrs["Version"], group.attrs["Type"] = (2, 0), np.bytes_("UnstructuredGrid")
        for key, numbers in tree.items():
            group[key] = numbers
        group["Steps"].attrs["NSteps"] = steps
    return file


def write_collection(path: Path, files: Sequence[tuple[float, str]]) -> None:
    """Write a PVD file for ParaView: times and names of VTU files, relative to its folder."""
    lines = [f'<DataSet timestep="{time:.6g}" file={quoteattr(name)}/>' for time, name in files]
    head = '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">'
    rows = ['<?xml version="1.0"?>', head, "<Collection>", *lines, "</Collection>", "</VTKFile>"]
    path.write_text("\n".join(rows) + "\n")

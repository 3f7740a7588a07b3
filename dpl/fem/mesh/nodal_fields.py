"""Read nodal fields that another program wrote: arrays in one file, or a folder of VTK files."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file
from scipy.spatial import cKDTree

from dpl.fem.mesh.sandbox_checks import check_file
from dpl.system.files import array_names, read_array

VTK = (".vtu", ".vtk", ".vtkhdf")
NEAR = 1e-5  # largest distance of a node in a file from that of the body, over its longest side [-]
Array = NDArray[np.float64]


def read_nodal_fields(
    path: str | Path, names: Sequence[str], points: Array, scale: float = 1.0
) -> list[Array]:
    """Return fields of a body, (S, N, D) each, S of them with their nodes in the order of `points`.

    A file .npz or .safetensors contains the fields as arrays (S, N, D) with these names. If it also
    contains an array `points` (N, D), the nodes are matched by position; otherwise they must have
    the order of `points`. A .npy file, and an .npz file with one array, contain one field.

    A folder contains VTK files (.vtu, .vtk, or .vtkhdf with h5py) in the order of their names, each
    with undeformed points, matched by position, and the fields as point arrays. A .vtkhdf file with
    steps contains several. They are read in this process without the limits of
    `dpl.fem.mesh.sandbox`: read files of sources that you trust.

    Args:
        path: The file or the folder.
        names: Names of the fields.
        points: Nodes of the body, (N, D) [m].
        scale: Unit of the points in the files [m].
    """
    path = Path(path)
    if not path.is_dir():
        return _read_arrays(path, names, points, scale)
    files = sorted(one for one in path.iterdir() if one.suffix.lower() in VTK)
    if not files:
        raise ValueError(f"the folder must contain files {', '.join(VTK)}")
    order, places, parts = np.arange(len(points)), None, []
    for file in files:
        try:
            read = _read_vtkhdf if file.suffix.lower() == ".vtkhdf" else _read_vtk
            found, fields = read(file, names)
            if places is None or not np.array_equal(found, places):
                order, places = _order(found, points, scale), found
            parts.append([_rows(field, points, order) for field in fields])
        except (ValueError, KeyError) as error:
            raise ValueError(f"{file.name}: {error.args[0] if error.args else error}") from error
    return [np.concatenate(field) for field in zip(*parts, strict=True)]


def _read_arrays(path: Path, names: Sequence[str], points: Array, scale: float) -> list[Array]:
    """Return the fields of one file of arrays."""
    if path.suffix == ".safetensors":
        arrays = {name: array.astype(np.float64) for name, array in load_file(path).items()}
        fields, places = [_named(arrays, name) for name in names], arrays.get("points")
    else:
        known = array_names(path) if path.suffix == ".npz" else []
        if len(names) > 1 and len(known) < 2:
            raise ValueError(f"the file must contain the arrays {', '.join(names)}")
        moved = "points" in known
        row = (-1, -1) if moved else points.shape
        fields = [read_array(path, row, name) for name in names]
        places = read_array(path, (-1,), "points") if moved else None
    order = np.arange(len(points)) if places is None else _order(places, points, scale)
    return [_rows(field, points, order) for field in fields]


def _read_vtk(path: Path, names: Sequence[str]) -> tuple[Array, list[Array]]:
    """Return the points (M, 3) of a VTK file and its fields, (S, M, 3) each."""
    check_file(path)
    try:
        mesh = meshio.read(path)
    except (SystemExit, Exception) as error:  # meshio ends the program on some damaged files
        text = " ".join(str(error).split())
        raise ValueError(f"cannot be read: it is damaged or ends too early ({text})") from error
    return mesh.points, [_named(mesh.point_data, name)[None] for name in names]


def _read_vtkhdf(path: Path, names: Sequence[str]) -> tuple[Array, list[Array]]:
    """Return the points and fields of all steps of a VTKHDF file of an unstructured grid."""
    try:
        import h5py
    except ImportError:
        raise ValueError("cannot be read without h5py: pip install h5py") from None
    try:
        with h5py.File(path) as file:
            grid = file["VTKHDF"]
            places, data = grid["Points"][()], grid["PointData"]
            fields = [_named(data, name)[()] for name in names]
    except OSError as error:
        raise ValueError(f"cannot be read: {error}") from error
    return places, [field.reshape(-1, len(places), field.shape[-1]) for field in fields]


def _named(fields: Mapping[str, Array], name: str) -> Array:
    if name not in fields:
        raise ValueError(f"has no array {name!r} at points; there are {', '.join(sorted(fields))}")
    return fields[name]


def _order(places: Array, points: Array, scale: float) -> NDArray[np.int_]:
    """Return the rows of `places` (M, 2 or 3) that are the nodes `points` (N, D) [m]."""
    dim = points.shape[1]
    if places.ndim != 2 or places.shape[1] < dim or not np.isfinite(places).all():
        raise ValueError(f"points of shape {places.shape} must be finite, (nodes, {dim})")
    near = NEAR * np.ptp(points, axis=0).max()
    distance, order = cKDTree(scale * places[:, :dim]).query(points, distance_upper_bound=near)
    if count := int(np.isinf(distance).sum()):
        k = int(np.isinf(distance).argmax())
        raise ValueError(
            f"has no point at {count} of {len(points)} nodes of the body, the first at "
            f"{np.array2string(points[k], precision=6)} m; check degree and the unit of the points"
        )
    return order


def _rows(field: Array, points: Array, order: NDArray[np.int_]) -> Array:
    """Return a field (S, M, 2 or 3) at the nodes, (S, N, D)."""
    dim = points.shape[1]
    if field.ndim != 3 or field.shape[1] <= order.max() or field.shape[2] < dim:
        raise ValueError(
            f"the array of shape {field.shape} must have rows of {len(points)} nodes: "
            f"(S, {len(points)}, {dim})"
        )
    return np.ascontiguousarray(field[:, order, :dim], dtype=np.float64)

"""Folder of an exported surrogate.

    model.onnx           the surrogate; weights above 2 GB are in model.onnx.data
    weights.safetensors  the weights, as in RUN/checkpoints
    meta.json            mesh, order of the degrees of freedom, scales, units, range, errors
    modes.f64            largest modal loads of the training, see `range` in meta.json
    reference/*.f64      a load, the surrogate's displacement and the finite-element displacement
    report.json          differences between ONNX and torch, and latencies

Files `*.f64` hold raw numbers: float64, little-endian, last axis fastest. meta.json has the shapes.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dpl.export.metadata import FORMAT
from dpl.export.onnx_graph import Array
from dpl.fem import HasModes
from dpl.system.files import atomic_write
from dpl.training import TrainedSurrogate, checkpoints

RAW = np.dtype("<f8")


def write_folder(
    folder: Path,
    surrogate: TrainedSurrogate,
    reference: Mapping[str, Array],
    meta: Mapping[str, Any],
) -> None:
    """Write all files except the graph and the report.

    `reference` are the arrays of `solve_reference`, `meta` the contents of meta.json.
    """
    scene, loads = surrogate.scene, surrogate.scene.loads
    (folder / "reference").mkdir(parents=True, exist_ok=True)
    for name, field in reference.items():
        write_raw(folder / "reference" / f"{name}.f64", field)
    if isinstance(loads, HasModes):
        write_raw(folder / "modes.f64", loads.modal_forces.numpy())
    weights = folder / "weights.safetensors"
    entries = checkpoints.entries_of_scene(scene)
    checkpoints.write({"state_dict": surrogate.state_dict(), **entries}, weights)
    lines = (f" {json.dumps(key)}: {json.dumps(value)}" for key, value in meta.items())
    with atomic_write(folder / "meta.json") as file:
        file.write(("{\n" + ",\n".join(lines) + "\n}\n").encode())


def write_raw(path: Path, field: Array) -> None:
    """Write an array as raw float64, little-endian, last axis fastest."""
    with atomic_write(path) as file:
        file.write(np.ascontiguousarray(field, dtype=RAW).tobytes())


def read_raw(path: Path, shape: list[int]) -> Array:
    """Return an array that `write_raw` wrote; raise ValueError if its size is not the shape's."""
    return np.fromfile(path, dtype=RAW).astype(np.float64).reshape(shape)


def read_metadata(folder: Path) -> dict[str, Any]:
    """Return the contents of meta.json; raise ValueError if it has another format version."""
    meta: dict[str, Any] = json.loads((folder / "meta.json").read_text())
    if meta.get("format") != FORMAT:
        raise ValueError(
            f"{folder / 'meta.json'}: format = {meta.get('format')} must be {FORMAT}; export the "
            "run again"
        )
    return meta


def read_reference(folder: Path) -> dict[str, Array]:
    """Return inputs and displacements of the reference load, by name."""
    shapes = read_metadata(folder)["reference"]["shapes"]
    return {
        name: read_raw(folder / "reference" / f"{name}.f64", shape)
        for name, shape in shapes.items()
    }

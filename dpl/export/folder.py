"""Folder of an exported surrogate.

    model.onnx           the surrogate; weights above 2 GB are in model.onnx.data
    weights.safetensors  the weights, as in RUN/checkpoints
    meta.json            mesh, order of the degrees of freedom, scales, units, range, errors
    modes.f64            largest modal loads of the training, see `range` in meta.json
    reference/*.f64      a load, the surrogate's displacement and the finite-element displacement
    report.json          differences between ONNX and torch

Files `*.f64` hold raw numbers: float64, little-endian, last axis fastest. meta.json has the shapes.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from skfem.io.meshio import to_meshio
from torch import Tensor

from dpl.export.comparison import CHECK_STREAM
from dpl.export.onnx_graph import Array
from dpl.export.quantities import NUMBERS
from dpl.fem import ModalLoads, Problem, evaluate_solution, solve, surface
from dpl.fem.mesh.writing import with_nodes
from dpl.fem.postprocess import triangles
from dpl.scene import Scene
from dpl.system.files import atomic_write
from dpl.training import TrainedSurrogate, checkpoints
from dpl.version import __version__

FORMAT = 4  # version of the keys of meta.json
MODEL = "model.onnx"
RANGE = (
    "f: a force over E L^(D-1), minus `constant_force`, and 0 at fixed degrees of freedom. "
    "q: the least-squares fit of `modes` to f at the nodes where f is not zero. "
    "In range: max |q| <= 1 and |f - modes q| <= 1e-3 |f| at these nodes. "
    "Without a fit: |f| above `largest_force` is out of range."
)


def write_folder(
    surrogate: TrainedSurrogate, folder: Path, *, tol: float, errors: Mapping[str, Any] | None
) -> None:
    """Write all files except the report for a surrogate whose model.onnx lies in the folder.

    `tol` is the largest relative difference of ONNX and torch [-]. `errors` are those on the test
    set, see `dpl.training.metrics`, if the run was evaluated.
    """
    scene, loads = surrogate.scene, surrogate.scene.loads
    (folder / "reference").mkdir(parents=True, exist_ok=True)
    fields, reference = _solve_reference(surrogate)
    for name, field in fields.items():
        _write_raw(folder / "reference" / f"{name}.f64", field)
    if isinstance(loads, ModalLoads):
        _write_raw(folder / "modes.f64", loads.modal_forces.numpy())
    weights = {"state_dict": surrogate.state_dict(), **checkpoints.entries_of_scene(scene)}
    checkpoints.write(weights, folder / "weights.safetensors")
    meta = _describe(surrogate, folder / MODEL, tol) | {"errors": errors, "reference": reference}
    lines = (f" {json.dumps(key)}: {json.dumps(value)}" for key, value in meta.items())
    with atomic_write(folder / "meta.json") as file:
        file.write(("{\n" + ",\n".join(lines) + "\n}\n").encode())


def _write_raw(path: Path, field: Array) -> None:
    """Write an array as raw float64, little-endian, last axis fastest."""
    with atomic_write(path) as file:
        file.write(np.ascontiguousarray(field, dtype="<f8").tobytes())


def _describe(surrogate: TrainedSurrogate, path: Path, tol: float) -> dict[str, Any]:
    """Return the contents of meta.json without errors and reference."""
    scene, predictor = surrogate.scene, surrogate.predictor
    loads, problem = scene.loads, scene.problem
    unit = "N" if problem.shape[1] == 3 else "N/m"
    law, ranges = problem.material.identity(), problem.material.parameter_ranges
    count = sum(parameter.numel() for parameter in surrogate.net.parameters())
    return {
        "format": FORMAT,
        "dpl": __version__,
        "scene": scene.fingerprint,
        "network": {"name": type(surrogate.net).__name__, "parameters": count},
        "model": {**_model(scene, path, unit), "tolerance": tol},
        "units": {"length": "m", "force": unit, "stress": "Pa", "young": "Pa"},
        "dofs": {
            "count": problem.free.numel(),
            "order": "node-major: D * node + component; components x, y, z",
            "fixed": _indices(~problem.free),
            "loadable": _indices(loads.loadable_dofs),
        },
        "scales": {
            "length": scene.length,
            "force_unit": scene.force_unit,
            "force": float(predictor.force_scale),
            "displacement": float(predictor.displacement_scale),
            "meaning": predictor.meaning,
        },
        "material": {
            "name": law.pop("name"),
            "parameters_over_E": law,
            "young": loads.moduli,
            **ranges,
        },
        "range": _range(scene),
        "mesh": _mesh(problem),
    }


def _model(scene: Scene, path: Path, force_unit: str) -> dict[str, Any]:
    """Return file and operator set, and name, shape, type and unit of each input and output."""
    import onnx

    stored = onnx.load(str(path), load_external_data=False)
    problem, loads, young = scene.problem, scene.loads, scene.loads.moduli[1]
    units = problem.material.units_of_ranges.items()
    units_of = {name: "Pa" for name, unit in units if unit and math.isclose(unit * young, 1)}
    units_of |= problem.follower_loads.units
    field = ["B", *problem.shape]
    known: dict[str, dict[str, Any]] = {
        "force": {"shape": field, "unit": force_unit},
        "young": {
            "shape": ["B"],
            "unit": "Pa",
            "range": loads.moduli,
            "distribution": "log" if loads.moduli.is_log else "uniform",
        },
        "parameters": {
            "shape": ["B", len(loads.parameter_ranges)],
            "unit": [units_of.get(name, "1") for name in loads.parameter_ranges],
            "ranges": loads.parameter_ranges,
        },
        "displacement": {"shape": field, "unit": "m"},
        **{name: {"shape": ["B"], "unit": "1"} for name in NUMBERS},
    }
    types = {onnx.TensorProto.DOUBLE: "float64", onnx.TensorProto.FLOAT: "float32"}
    inputs, outputs = (
        [
            {"name": one.name, "type": types[one.type.tensor_type.elem_type], **known[one.name]}
            for one in values
        ]
        for values in (stored.graph.input, stored.graph.output)
    )
    opset = int(stored.opset_import[0].version)
    return {"file": path.name, "opset": opset, "inputs": inputs, "outputs": outputs}


def _indices(mask: Tensor) -> list[int]:
    return mask.flatten().nonzero()[:, 0].tolist()


def _range(scene: Scene) -> dict[str, Any]:
    """Return the data by which a program checks whether a force is in the training range."""
    loads, constant = scene.loads, scene.loads.constant_force
    found = {
        "family": loads.identity(),
        "constant_force": None if constant is None else constant.flatten().tolist(),
        "largest_force": loads.largest_force,
        "meaning": RANGE,
    }
    if isinstance(loads, ModalLoads):
        found["modes"] = {"file": "modes.f64", "shape": list(loads.modal_forces.shape)}
    return found


def _mesh(problem: Problem) -> dict[str, Any]:
    (block,) = to_meshio(with_nodes(problem.mesh, len(problem.points))).cells
    return {
        "points": problem.points_in_metres.tolist(),
        "cell_type": block.type,
        "cell_order": "VTK",
        "cells": block.data.tolist(),
        "triangles": triangles(surface(problem.mesh)).tolist(),
    }


def _solve_reference(
    surrogate: TrainedSurrogate, *, max_loads: int = 16
) -> tuple[dict[str, Array], dict[str, Any]]:
    """Return the first random load for which Newton converges, and its entry in meta.json.

    Of `max_loads` loads the last one is taken in any case. The arrays, by file name, are the inputs
    of the graph with B = 1 and both displacements, (1, N, D) [m]. Residuals and `error`, the
    difference of the displacements, are relative [-]. Without a known law there is a load with the
    displacement of the surrogate alone.
    """
    scene = surrogate.scene
    is_known, numbers = scene.problem.material.is_known, dict[str, Any]()
    for k in range(max_loads):
        load = scene.loads.sample(CHECK_STREAM, [k])
        inputs = scene.si_inputs(load)
        with torch.inference_mode():
            fields = inputs | {"displacement": surrogate(**inputs)}
        if not is_known or bool((fe := solve(scene.solver, load)).converged):
            break
    if is_known:
        u = fields["displacement"].clone() / scene.length
        found = evaluate_solution(scene.problem, u, load, scene.solver.tol)
        fields["fe_displacement"] = scene.length * fe.displacement
        numbers = {
            "residual": float(found.residual),
            "fe_residual": float(fe.residual),
            "fe_converged": bool(fe.converged),
            "error": float((u - fe.displacement).norm() / fe.displacement.norm()),
        }
    return {name: field.numpy() for name, field in fields.items()}, {
        "folder": "reference",
        "shapes": {name: list(field.shape) for name, field in fields.items()},
        **numbers,
    }

"""The folder that is handed on: graph, weights, description, and a load with its answer.

    model.onnx           the surrogate; model.onnx.data beside it where it has more than 2 GB
    weights.safetensors  the weights alone, as in RUN/checkpoints
    meta.json            the body, the order of its degrees of freedom, scales, units, range, errors
    modes.f64            largest modal loads of the training, see `range` in meta.json
    reference/*.f64      inputs, the answer to them, and what finite elements say
    report.json          how far the graph is from torch, and times

Files of numbers are raw: float64, little-endian, last axis fastest, so that a program in C++ reads
them in a line; shapes stand in meta.json.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dpl.export.check import TRIED
from dpl.export.onnx_graph import Array, Graph, opset
from dpl.fem import Problem, evaluate_solution, solve, surface
from dpl.fem.mesh.writing import flat_cells
from dpl.fem.postprocess import triangles
from dpl.scene import Scene
from dpl.system.files import atomic_write
from dpl.training import Surrogate, checkpoints
from dpl.version import __version__

FORMAT = 1  # of meta.json; a later one may mean something else by a key
RAW = np.dtype("<f8")
RANGE = (
    "f: a force over E L^(D-1), less `constant_force`, and 0 where held. q: the least-squares fit "
    "of `modes` to f on the nodes on which f acts. In range: max |q| is 1 or less, and "
    "|f - modes q| <= 1e-3 |f| there. Without a fit: |f| above `largest_force` is out of range."
)


@dataclass(frozen=True)
class Reference:
    """A load with its answers.

    Attributes:
        inputs: By name, (1, N, D) [N], (1,) [Pa], (1,) [-].
        displacement: Of the surrogate, (1, N, D) [m].
        exact: Of finite elements, (1, N, D) [m].
        residual: ||R_free|| / ||f|| of the surrogate's answer [-].
        exact_residual: Of the other [-].
        converged: Whether that is below the tolerance of the scene.
        local: Whether the load is local after all.
        error: Relative difference of the two, ||a - b|| / ||b|| [-].
    """

    inputs: dict[str, Array]
    displacement: Array
    exact: Array
    residual: float
    exact_residual: float
    converged: bool
    local: bool
    error: float

    def fields(self) -> dict[str, Array]:
        """Return what is written, by name of its file."""
        return {**self.inputs, "displacement": self.displacement, "exact": self.exact}


def reference(graph: Graph, *, most: int = 16) -> Reference:
    """Return the first load of a stream of its own that is not local and that is solved.

    Args:
        graph: Of whose surrogate.
        most: Loads that are tried; the last is taken as it is.
    """
    scene = graph.surrogate.scene
    for k in range(most):
        load = scene.loads.sample(TRIED, [k])
        force = load.force * (load.young * scene.force_unit)[:, None, None]
        given = [force, load.young, *([load.poisson[:, 0]] if load.poisson.shape[1] else [])]
        with torch.inference_mode():
            metres, *local = graph(*given)
        exact = solve(scene.solver, load)
        if bool(exact.converged) and not any(map(bool, local)):
            break
    answer = evaluate_solution(scene.problem, metres.clone() / scene.length, load, scene.solver.tol)
    apart = (answer.displacement - exact.displacement).norm() / exact.displacement.norm()
    return Reference(
        {name: one.numpy() for name, one in zip(graph.inputs, given, strict=True)},
        metres.numpy(),
        (scene.length * exact.displacement).numpy(),
        float(answer.residual),
        float(exact.residual),
        bool(exact.converged),
        any(map(bool, local)),
        float(apart),
    )


def described(
    graph: Graph, path: Path, told: Reference, *, tol: float, errors: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return what meta.json says.

    Args:
        graph: What was written.
        path: Where.
        told: The reference.
        tol: Largest relative difference of graph and torch [-].
        errors: Of the network on the test set, see `dpl.training.metrics`; None if it was not
            evaluated.
    """
    module, scene = graph.surrogate, graph.surrogate.scene
    nodes, dim = scene.problem.shape
    loads, newton = scene.loads, "N" if dim == 3 else "N/m"
    field = ["B", nodes, dim]
    known = {
        "force": {"shape": field, "type": "float64", "unit": newton},
        "young": {"shape": ["B"], "type": "float64", "unit": "Pa", "range": loads.young_range},
        "poisson": {"shape": ["B"], "type": "float64", "unit": "1", "range": loads.poisson_range},
        "displacement": {"shape": field, "type": "float64", "unit": "m"},
        "local": {
            "shape": ["B"],
            "type": "bool",
            "unit": "1",
            "meaning": "the load is too local for the network's basis: dpl would add the linear "
            "answer of a factor of K(0), which the graph cannot hold; do not trust this answer",
        },
    }
    count = sum(parameter.numel() for parameter in module.net.parameters())
    return {
        "format": FORMAT,
        "dpl": __version__,
        "scene": scene.fingerprint,
        "network": {"name": type(module.net).__name__, "parameters": count},
        "model": {
            "file": path.name,
            "opset": opset(path),
            "inputs": [{"name": name, **known[name]} for name in graph.inputs],
            "outputs": [{"name": name, **known[name]} for name in graph.outputs],
            "tolerance": tol,
        },
        "units": {"length": "m", "force": newton, "stress": "Pa", "young": "Pa"},
        "dofs": {
            "count": nodes * dim,
            "order": "node-major: D * node + component; components x, y, z",
            "held": _numbers(~scene.problem.free),
            "acting": _numbers(loads.loadable_dofs),
        },
        "scales": {
            "length": scene.length,
            "force_unit": scene.force_unit,
            "force": float(module.force_scale),
            "displacement": float(module.displacement_scale),
            "meaning": "in = force / (young force_unit scales.force); network; "
            "displacement = length scales.displacement out, 0 where held",
        },
        "material": {**_law(scene), "young": loads.young_range, "poisson": loads.poisson_range},
        "range": _range(scene),
        "errors": errors,
        "reference": {
            "folder": "reference",
            "shapes": {name: list(one.shape) for name, one in told.fields().items()},
            "residual": told.residual,
            "exact_residual": told.exact_residual,
            "exact_converged": told.converged,
            "local": told.local,
            "error": told.error,
        },
        "mesh": _mesh(scene.problem),
    }


def _numbers(where: Tensor) -> list[int]:
    return where.flatten().nonzero()[:, 0].tolist()


def _law(scene: Scene) -> dict[str, Any]:
    law = dict(scene.identity()["law"])  # type: ignore[call-overload]
    return {"name": law.pop("name"), "parameters_over_E": law}


def _range(scene: Scene) -> dict[str, Any]:
    """Return what tells whether a force lies in the range of the training."""
    loads = scene.loads
    return {
        "modes": {"file": "modes.f64", "shape": [*scene.problem.shape, len(loads.q_max)]},
        "always": None if loads.constant_force is None else loads.constant_force.flatten().tolist(),
        "largest_force": loads.largest_force,
        "deflection": loads.deflection,
        "patch": [scene.length * float(radius) for radius in loads.patch],
        "meaning": RANGE,
    }


def _mesh(problem: Problem) -> dict[str, Any]:
    kind, cells = flat_cells(problem.mesh, len(problem.points))
    return {
        "points": (problem.length * (problem.points.numpy() + problem.origin)).tolist(),
        "cell_type": kind,
        "cell_order": "VTK",
        "cells": cells.tolist(),
        "triangles": triangles(surface(problem.mesh)).tolist(),
    }


def write(folder: Path, surrogate: Surrogate, told: Reference, meta: Mapping[str, Any]) -> None:
    """Write all but the graph and the report.

    Args:
        folder: Where; made if it is not there.
        surrogate: Whose weights.
        told: The reference.
        meta: What meta.json says.
    """
    scene, loads = surrogate.scene, surrogate.scene.loads
    (folder / "reference").mkdir(parents=True, exist_ok=True)
    for name, field in told.fields().items():
        write_raw(folder / "reference" / f"{name}.f64", field)
    modes = torch.where(loads.loadable_dofs[..., None], loads.modes.vectors, 0.0) * loads.q_max
    write_raw(folder / "modes.f64", modes.numpy())
    checkpoint: dict[str, Any] = {"state_dict": surrogate.state_dict()}
    checkpoint |= {"scene": scene.fingerprint, "identity": scene.identity()}
    checkpoints.write(checkpoint, folder / "weights.safetensors")
    lines = (f" {json.dumps(key)}: {json.dumps(value)}" for key, value in meta.items())
    with atomic_write(folder / "meta.json") as file:
        file.write(("{\n" + ",\n".join(lines) + "\n}\n").encode())


def write_raw(path: Path, field: Array) -> None:
    """Write numbers as they lie in memory, float64, little-endian."""
    with atomic_write(path) as file:
        file.write(np.ascontiguousarray(field, dtype=RAW).tobytes())


def read_raw(path: Path, shape: list[int]) -> Array:
    """Return what `write_raw` wrote.

    Raises:
        ValueError: It holds another number of numbers.
    """
    return np.fromfile(path, dtype=RAW).astype(np.float64).reshape(shape)


def read_meta(folder: Path) -> dict[str, Any]:
    """Return what meta.json says.

    Raises:
        ValueError: It is of another format.
    """
    meta: dict[str, Any] = json.loads((folder / "meta.json").read_text())
    if meta.get("format") != FORMAT:
        raise ValueError(f"{folder} has format {meta.get('format')}, of which {FORMAT} is read")
    return meta


def read_reference(folder: Path) -> dict[str, Array]:
    """Return inputs and answers of the reference, by name."""
    shapes = read_meta(folder)["reference"]["shapes"]
    return {
        name: read_raw(folder / "reference" / f"{name}.f64", shape)
        for name, shape in shapes.items()
    }


def verify(folder: Path, surrogate: Surrogate, told: Reference, meta: Mapping[str, Any]) -> None:
    """Hold what was written to what was meant, bit for bit.

    Raises:
        ValueError: It differs.
    """
    if read_meta(folder) != json.loads(json.dumps(meta)):
        raise ValueError(f"{folder / 'meta.json'} is not what was written")
    found = read_reference(folder)
    for name, field in told.fields().items():
        if not np.array_equal(found[name], field):
            raise ValueError(f"{folder / 'reference' / name}.f64 is not what was written")
    weights = checkpoints.read(folder / "weights.safetensors")["state_dict"]
    for name, tensor in surrogate.state_dict().items():
        if not torch.equal(weights[name], tensor):
            raise ValueError(f"{folder / 'weights.safetensors'}: {name} is not what was written")

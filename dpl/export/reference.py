"""Reference load of an export: the surrogate's displacement and the finite-element solution."""

from dataclasses import dataclass
from typing import Any

import torch

from dpl.export.comparison import CHECK_STREAM
from dpl.export.onnx_graph import Array, ExportGraph
from dpl.fem import evaluate_solution, solve


@dataclass(frozen=True)
class Reference:
    """A load with two displacements.

    Attributes:
        inputs: Inputs of the graph by name, (1, N, D) [N], (1,) [Pa], (1,) [-].
        displacement: Displacement of the surrogate, (1, N, D) [m].
        fe_displacement: Finite-element displacement, (1, N, D) [m].
        residual: ||R_free|| / ||f|| of the surrogate's displacement [-].
        fe_residual: The same of the finite-element displacement [-].
        fe_converged: True if `fe_residual` is below the tolerance of the scene.
        local: True if the graph marks the load as local.
        error: Relative difference of the two displacements, ||a - b|| / ||b|| [-].
    """

    inputs: dict[str, Array]
    displacement: Array
    fe_displacement: Array
    residual: float
    fe_residual: float
    fe_converged: bool
    local: bool
    error: float

    def fields(self) -> dict[str, Array]:
        """Return the arrays that are written, by file name."""
        displacements = {"displacement": self.displacement, "fe_displacement": self.fe_displacement}
        return {**self.inputs, **displacements}

    def describe(self) -> dict[str, Any]:
        """Return the entry `reference` of meta.json."""
        return {
            "folder": "reference",
            "shapes": {name: list(field.shape) for name, field in self.fields().items()},
            "residual": self.residual,
            "fe_residual": self.fe_residual,
            "fe_converged": self.fe_converged,
            "local": self.local,
            "error": self.error,
        }


def solve_reference(graph: ExportGraph, *, max_loads: int = 16) -> Reference:
    """Return the first random load that is not local and for which Newton converges.

    Args:
        graph: The graph.
        max_loads: Largest number of loads to try; the last one is taken in any case.
    """
    scene = graph.surrogate.scene
    for k in range(max_loads):
        load = scene.loads.sample(CHECK_STREAM, [k])
        force = load.force * (load.young * scene.force_unit)[:, None, None]
        inputs = [force, load.young, *([load.poisson[:, 0]] if load.poisson.shape[1] else [])]
        with torch.inference_mode():
            metres, *flags = graph(*inputs)
        local = any(map(bool, flags))
        fe = solve(scene.solver, load)
        if bool(fe.converged) and not local:
            break
    found = evaluate_solution(scene.problem, metres.clone() / scene.length, load, scene.solver.tol)
    difference = (found.displacement - fe.displacement).norm() / fe.displacement.norm()
    return Reference(
        {name: array.numpy() for name, array in zip(graph.inputs, inputs, strict=True)},
        metres.numpy(),
        (scene.length * fe.displacement).numpy(),
        float(found.residual),
        float(fe.residual),
        bool(fe.converged),
        local,
        float(difference),
    )

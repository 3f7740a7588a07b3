"""Reference load of an export: the surrogate's displacement and the finite-element solution."""

from dataclasses import asdict, dataclass
from typing import Any

import torch

from dpl.export.comparison import CHECK_STREAM
from dpl.export.onnx_graph import Array, ExportGraph
from dpl.fem import evaluate_solution, solve


@dataclass(frozen=True)
class Reference:
    """A load with two displacements.

    Attributes:
        fields: Arrays by file name: the inputs of the graph with B = 1, `displacement` of the
            surrogate and `fe_displacement`, (1, N, D) [m].
        residual: ||R_free|| / ||f|| of the surrogate's displacement [-].
        fe_residual: The same of the finite-element displacement [-].
        fe_converged: True if `fe_residual` is below the tolerance of the scene.
        error: Relative difference of the two displacements, ||a - b|| / ||b|| [-].
    """

    fields: dict[str, Array]
    residual: float
    fe_residual: float
    fe_converged: bool
    error: float

    def describe(self) -> dict[str, Any]:
        """Return the entry `reference` of meta.json."""
        numbers = asdict(self)
        shapes = {name: list(field.shape) for name, field in numbers.pop("fields").items()}
        return {"folder": "reference", "shapes": shapes, **numbers}


def solve_reference(graph: ExportGraph, *, max_loads: int = 16) -> Reference:
    """Return the first random load for which Newton converges.

    Of `max_loads` loads the last one is taken in any case.
    """
    scene = graph.surrogate.scene
    for k in range(max_loads):
        load = scene.loads.sample(CHECK_STREAM, [k])
        inputs = scene.si_inputs(load)
        with torch.inference_mode():
            metres = graph(**inputs)
        fe = solve(scene.solver, load)
        if bool(fe.converged):
            break
    found = evaluate_solution(scene.problem, metres.clone() / scene.length, load, scene.solver.tol)
    difference = (found.displacement - fe.displacement).norm() / fe.displacement.norm()
    displacements = {"displacement": metres, "fe_displacement": scene.length * fe.displacement}
    return Reference(
        {name: field.numpy() for name, field in (inputs | displacements).items()},
        float(found.residual),
        float(fe.residual),
        bool(fe.converged),
        float(difference),
    )

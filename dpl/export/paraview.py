"""Files for ParaView: forces, displacements, stresses and det F at the nodes."""

from dataclasses import dataclass, field
from pathlib import Path

import torch

from dpl.evaluation.nodal_fields import nodal_fields
from dpl.fem import Load, solve, write_series
from dpl.training import TrainedSurrogate


@dataclass(frozen=True)
class ResultRow:
    """Row of `results.csv`: the prediction for one load; extrema are those of the nodes."""

    load: int  # index in the series
    young: float = field(metadata={"unit": "Pa"})
    max_displacement: float = field(metadata={"unit": "m"})
    max_von_mises: float = field(metadata={"unit": "Pa"})
    min_det_F: float
    # relative L2 error of the displacement; NaN without a converged finite-element solution
    error: float = field(metadata={"unit": "%"})


def write_results(
    surrogate: TrainedSurrogate, load: Load, path: Path, *, solve_reference: bool = True
) -> tuple[list[ResultRow], list[Path]]:
    """Write predictions as a series of files for ParaView, see `dpl.fem.write_series`.

    `path` is that of the series, without a suffix. With `solve_reference` the finite-element
    displacement and the error are written too, unless the law is unknown. Returns one row for each
    load, and the paths of the series.
    """
    scene = surrogate.scene
    rows, steps = [], []
    for k, single in enumerate(load.unbatch()):
        with torch.no_grad():
            prediction = surrogate.predict(single)[0]
        truth = None
        if solve_reference and scene.problem.material.is_known:
            found = solve(scene.solver, single)
            truth = torch.where(found.converged, found.displacement[0], torch.nan)
        step = nodal_fields(scene, single, prediction, truth)
        steps.append({name: field.numpy() for name, field in step.items()})
        error = torch.nan if truth is None else float((prediction - truth).norm() / truth.norm())
        moved = float(step["displacement [m]"].norm(dim=1).max())
        inside = float(step["von Mises stress [Pa]"].max()), float(step["det F"].min())
        rows.append(ResultRow(k, float(single.young), moved, *inside, error))
    return rows, write_series(path, scene.problem.mesh_in_metres, steps)

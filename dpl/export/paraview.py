"""Files for ParaView: forces, displacements, stresses and det F at the nodes."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from dpl.fem import Load, fields, solve, write_series
from dpl.scene import Scene
from dpl.training import Surrogate


@dataclass(frozen=True)
class ResultRow:
    """Row of `results.csv`: the prediction for one load.

    Attributes:
        load: Index of the load in the series.
        young: Young's modulus [Pa].
        max_displacement: Largest displacement of a node [m].
        max_von_mises: Largest von Mises stress at a node [Pa].
        min_det_F: Smallest det F at a node [-].
        error: Relative L2 error against the finite-element solution [-]; NaN if it was not
            computed or did not converge.
    """

    load: int
    young: float
    max_displacement: float
    max_von_mises: float
    min_det_F: float
    error: float


def write_results(
    surrogate: Surrogate, load: Load, path: Path, *, solve_reference: bool = True
) -> tuple[list[ResultRow], list[Path]]:
    """Write predictions as a series of VTU files, a PVD collection and an XDMF file.

    `path` is that of the series, without a suffix. With `solve_reference` the finite-element
    displacement and the error are written too. Returns one row for each load, and the paths of the
    PVD and the XDMF file.
    """
    scene = surrogate.scene
    rows, steps = [], []
    for k, single in enumerate(load.unbatch()):
        with torch.no_grad():
            prediction = surrogate.predict(single)[0]
        truth = None
        if solve_reference:
            found = solve(scene.solver, single)
            truth = torch.where(found.converged, found.displacement[0], torch.nan)
        step = nodal_fields(scene, single, prediction, truth)
        steps.append({name: field.numpy() for name, field in step.items()})
        error = torch.nan if truth is None else float((prediction - truth).norm() / truth.norm())
        moved = float(step["displacement [m]"].norm(dim=1).max())
        inside = float(step["von Mises stress [Pa]"].max()), float(step["det F"].min())
        rows.append(ResultRow(k, float(single.young), moved, *inside, error))
    return rows, write_series(path, scene.problem.mesh_in_metres, steps)


def nodal_fields(
    scene: Scene, load: Load, displacement: Tensor, reference: Tensor | None = None
) -> dict[str, Tensor]:
    """Return named fields at the nodes in SI units, (N, ...), for one load.

    Both displacements, that to show and the finite-element one, are over L, (N, D) [-].
    """
    young = float(load.young)
    newton = "N" if scene.problem.shape[1] == 3 else "N/m"
    stress = fields(scene.problem.with_parameters(load.parameters), displacement[None])
    found = {
        f"force [{newton}]": young * scene.force_unit * load.force[0],
        "displacement [m]": scene.length * displacement,
        "Cauchy stress [Pa]": young * stress.stress[0],
        "von Mises stress [Pa]": young * stress.von_mises[0],
        "det F": stress.volume_ratio[0],
    }
    if reference is not None:
        found["reference displacement [m]"] = scene.length * reference
        found["error [m]"] = scene.length * (displacement - reference).norm(dim=1)
    return found

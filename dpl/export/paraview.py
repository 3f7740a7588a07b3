"""Answers as ParaView opens them: forces, displacements, stress and volume ratio at the nodes."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from dpl.fem import Load, fields, solve, write_series
from dpl.scene import Scene
from dpl.training import Surrogate


@dataclass(frozen=True)
class Row:
    """One load.

    Attributes:
        load: Its number in the series.
        young: E [Pa].
        displacement: Largest of all nodes [m].
        von_mises: Largest of all nodes [Pa].
        volume_ratio: Smallest det F of all nodes [-].
        error: Relative L2 error against finite elements [-]; NaN where they were not asked or
            found no equilibrium.
    """

    load: int
    young: float
    displacement: float
    von_mises: float
    volume_ratio: float
    error: float


def results(
    surrogate: Surrogate, load: Load, path: Path, *, exact: bool = True
) -> tuple[list[Row], list[Path]]:
    """Write answers to loads as a series of VTU files, a PVD collection and an XDMF file.

    Args:
        surrogate: That answers.
        load: B of them, dimensionless.
        path: Of the series, without a suffix.
        exact: Solve them too, and write displacement and error beside.

    Returns:
        A row for each load, and the two files to open.
    """
    scene = surrogate.scene
    rows, steps = [], []
    for k, single in enumerate(load.unbatch()):
        with torch.no_grad():
            answer = surrogate.predict(single)[0]
        truth = None
        if exact:
            found = solve(scene.solver, single)
            truth = torch.where(found.converged, found.displacement[0], torch.nan)
        step = shown(scene, single, answer, truth)
        steps.append({name: field.numpy() for name, field in step.items()})
        error = float((answer - truth).norm() / truth.norm()) if truth is not None else torch.nan
        rows.append(
            Row(
                k,
                float(single.young),
                float(step["displacement [m]"].norm(dim=1).max()),
                float(step["von Mises stress [Pa]"].max()),
                float(step["det F"].min()),
                error,
            )
        )
    return rows, write_series(path, scene.problem.mesh_in_metres, steps)


def shown(
    scene: Scene, load: Load, answer: Tensor, truth: Tensor | None = None
) -> dict[str, Tensor]:
    """Return what is shown of one load, at the nodes, in SI units.

    Args:
        scene: What is answered.
        load: One, dimensionless.
        answer: (N, D) [-].
        truth: The same by finite elements.
    """
    young = float(load.young)
    newton = "N" if scene.problem.shape[1] == 3 else "N/m"
    inside = fields(scene.problem.at(load.poisson), answer[None])
    found = {
        f"force [{newton}]": young * scene.force_unit * load.force[0],
        "displacement [m]": scene.length * answer,
        "Cauchy stress [Pa]": young * inside.stress[0],
        "von Mises stress [Pa]": young * inside.von_mises[0],
        "det F": inside.volume_ratio[0],
    }
    if truth is not None:
        found["exact displacement [m]"] = scene.length * truth
        found["error [m]"] = scene.length * (answer - truth).norm(dim=1)
    return found

"""Named fields at the nodes in SI units, for files that ParaView reads."""

from torch import Tensor

from dpl.fem import Load, fields
from dpl.scene import Scene


def nodal_fields(
    scene: Scene, load: Load, displacement: Tensor, reference: Tensor | None = None
) -> dict[str, Tensor]:
    """Return named fields at the nodes in SI units, (N, ...), for one load.

    Displacements are over L, (N, D) [-]. A reference solution adds its fields, "reference ...", and
    "error [m]", the distance between both positions of a node.
    """
    newton = "N" if scene.problem.shape[1] == 3 else "N/m"
    young, problem = float(load.young), scene.problem.with_parameters(load.parameters)
    found = {f"force [{newton}]": young * scene.force_unit * load.force[0]}
    for name, u in {"": displacement, "reference ": reference}.items():
        if u is not None:
            stress = fields(problem, u.double()[None])
            found |= {
                f"{name}displacement [m]": scene.length * u,
                f"{name}Cauchy stress [Pa]": young * stress.stress[0],
                f"{name}von Mises stress [Pa]": young * stress.von_mises[0],
                f"{name}pressure [Pa]": young * stress.pressure[0],
                f"{name}det F": stress.volume_ratio[0],
            }
    if reference is not None:
        found["error [m]"] = scene.length * (displacement - reference).norm(dim=1)
    return found

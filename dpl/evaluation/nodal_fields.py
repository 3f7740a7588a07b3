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
    force = float(load.young) * scene.force_unit * load.force[0]
    found = {f"force [{newton}]": force, **_of_displacement(scene, load, displacement)}
    if reference is not None:
        known = _of_displacement(scene, load, reference)
        found |= {f"reference {name}": field for name, field in known.items()}
        found["error [m]"] = scene.length * (displacement - reference).norm(dim=1)
    return found


def _of_displacement(scene: Scene, load: Load, displacement: Tensor) -> dict[str, Tensor]:
    young = float(load.young)
    stress = fields(scene.problem.with_parameters(load.parameters), displacement.double()[None])
    return {
        "displacement [m]": scene.length * displacement,
        "Cauchy stress [Pa]": young * stress.stress[0],
        "von Mises stress [Pa]": young * stress.von_mises[0],
        "det F": stress.volume_ratio[0],
    }

"""Load families, their random numbers, and tractions and body forces."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.loads.distributed import CableLoads, FacePressure, FaceTractions, GravityLoads
    from dpl.fem.loads.family import HasModes, LoadFamily, RandomLoads, SurfaceLoads
    from dpl.fem.loads.file import FileLoads
    from dpl.fem.loads.forces import BodyForce, Traction, body_force, traction
    from dpl.fem.loads.mixture import MixtureLoads
    from dpl.fem.loads.modal import ModalLoads
    from dpl.fem.loads.modal_basis import Modes, eigenmodes
    from dpl.fem.loads.patch import PatchLoads
    from dpl.fem.loads.point import PointLoads
    from dpl.fem.loads.sampling import (
        constant,
        log_tail_mixture,
        logarithmic,
        normal,
        symmetric_uniform,
        uniform01,
    )
    from dpl.fem.loads.sized import CombinedLoads, SizedLoads, VectorLoads
    from dpl.fem.options import option
else:
    __all__, __getattr__, __dir__ = public_names(__name__)

"""Bases of load families, distributions, tractions and body forces; families are in `dpl.fem`."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.loads.family import SurfaceLoads
    from dpl.fem.loads.forces import body_force, traction
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

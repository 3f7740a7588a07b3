"""Reduced-order models: POD, cubature of cells (ECSW), Newton's method in a subspace."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.rom.ecsw import Cubature, cubature
    from dpl.fem.rom.pod import POD
    from dpl.fem.rom.subspace_newton import SubspaceNewton, SubspaceState
else:
    __all__, __getattr__, __dir__ = public_names(__name__)

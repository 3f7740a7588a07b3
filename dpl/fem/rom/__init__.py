"""Reduced-order models: POD, cubature of cells (ECSW), Galerkin projection."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.rom.ecsw import Cubature, cubature
    from dpl.fem.rom.galerkin import PODGalerkin, Reduced
    from dpl.fem.rom.pod import POD
    from dpl.fem.rom.reduced_problem import ReducedProblem
    from dpl.fem.rom.subspace_newton import SubspaceNewton, SubspaceState
else:
    __all__, __getattr__, __dir__ = public_names(__name__)

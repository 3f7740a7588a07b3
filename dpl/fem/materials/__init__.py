"""Hyperelastic laws."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.materials.fibres.directions import (
        ConstantFibres,
        FibreData,
        FibreFunction,
        LaplaceFibres,
    )
    from dpl.fem.materials.fibres.energies import (
        FibreEnergy,
        Guccione,
        HolzapfelGasserOgdenFibres,
        HolzapfelOgdenFibres,
    )
    from dpl.fem.materials.fibres.reinforced import FibreDirections, FibreReinforced
    from dpl.fem.materials.heterogeneous import Heterogeneous
    from dpl.fem.materials.invariant_based import InvariantBasedMaterial
    from dpl.fem.materials.isochoric import DemirayK2, MooneyRivlinK2, YeohK2
    from dpl.fem.materials.linear_elastic import LinearElastic, SaintVenantKirchhoff
    from dpl.fem.materials.material import Material, Response, YoungPoissonMaterial
    from dpl.fem.materials.neo_hookean import (
        NeoHookeanIsoK2,
        NeoHookeanIsoK4,
        NeoHookeanLn,
        StableNeoHookean,
    )
    from dpl.fem.materials.ogden import OgdenK2
    from dpl.fem.materials.parameters import CellField
    from dpl.fem.materials.volumetric import VolumetricK2, VolumetricK4
else:
    __all__, __getattr__, __dir__ = public_names(__name__)

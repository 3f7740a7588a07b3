"""Stresses, energies and the surface of a body, computed from displacements."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.postprocess.energy import RestStiffness, potential_energy, tangent_product
    from dpl.fem.postprocess.stress import cauchy, von_mises
    from dpl.fem.postprocess.surface import coarse, facet_edges, triangle_normals, triangles
else:
    __all__, __getattr__, __dir__ = public_names(__name__)

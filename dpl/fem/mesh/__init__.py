"""Meshes: made, read from files, checked and written; regions of a body."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.mesh.generators import box, rectangle
    from dpl.fem.mesh.propeller_mesh import propeller
    from dpl.fem.mesh.reading import load
    from dpl.fem.mesh.regions import Box, Cylinder, Plane, Sphere, Tag, facets_in, nodes_in
    from dpl.fem.mesh.validation import check
    from dpl.fem.mesh.writing import save, save_collection, save_exactly, save_series
else:
    __all__, __getattr__, __dir__ = public_names(__name__)

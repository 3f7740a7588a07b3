"""Meshes: made, read from files, checked and written; regions of a body."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.mesh.generators import box, finger, rectangle
    from dpl.fem.mesh.propeller_mesh import propeller
    from dpl.fem.mesh.reading import read_cell_data, read_mesh
    from dpl.fem.mesh.regions import (
        Box,
        Cylinder,
        Plane,
        Sphere,
        Tag,
        cells_in,
        facets_in,
        group_names,
        nodes_in,
    )
    from dpl.fem.mesh.validation import check_mesh
    from dpl.fem.mesh.writing import write_collection, write_mesh, write_mesh_exactly, write_series
else:
    __all__, __getattr__, __dir__ = public_names(__name__)

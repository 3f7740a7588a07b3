"""Evaluation of regions, checks of meshes and collections; meshes and regions are in `dpl.fem`."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.mesh.regions import cells_in, facets_in, group_names, nodes_in
    from dpl.fem.mesh.validation import check_mesh
    from dpl.fem.mesh.writing import write_collection
else:
    __all__, __getattr__, __dir__ = public_names(__name__)

"""Base of load families that act on the boundary or on a region of it."""

from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.identity import plain
from dpl.fem.loads.family import RandomLoads
from dpl.fem.mesh.regions import Region, facets_in
from dpl.system.checks import named_errors


@dataclass(frozen=True, eq=False)
class SurfaceLoads(RandomLoads):
    """Base of load families that act on facets of the boundary.

    Attributes:
        region: Part of the boundary, see `dpl.fem.mesh.facets_in`; None for all of it.
    """

    _: KW_ONLY
    region: Region | None = None

    @cached_property
    def facets(self) -> NDArray[np.int_]:
        """Numbers of the boundary facets on which these loads act, (E,)."""
        problem = self.problem
        if self.region is None:
            return np.asarray(problem.mesh.boundary_facets())
        with named_errors("region = "):
            return facets_in(self.region, problem.mesh, problem.length, problem.origin)

    @cached_property
    def loadable_dofs(self) -> Tensor:
        """Free degrees of freedom of the nodes of `facets`, (N, D), boolean."""
        nodes = torch.zeros(self.problem.shape[0], dtype=torch.bool)
        nodes[self.problem.basis.get_dofs(self.facets).all()] = True
        loadable = nodes[:, None] & self.problem.free
        if not loadable.any():
            words = "the boundary" if self.region is None else f"region = {self.region}"
            raise ValueError(f"{words} is fixed everywhere; loads must act on a free node")
        return loadable

    def identity(self) -> dict[str, Any]:
        """Return the options; a region is identified by the facets that it selects."""
        options = super().identity()
        del options["region"]
        return options if self.region is None else options | {"region": plain(self.facets)}

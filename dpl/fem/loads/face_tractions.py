"""Random uniform tractions on a part of the boundary."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from dpl.fem.loads.combined import VectorLoads
from dpl.fem.loads.forces import facet_areas
from dpl.fem.loads.sampling import Array
from dpl.fem.loads.sized import check_largest, traction_sizes
from dpl.fem.loads.surface import SurfaceLoads


@dataclass(frozen=True, eq=False)
class FaceTractions(SurfaceLoads, VectorLoads):
    """Uniform dead traction of random direction and size on the whole region.

    The point of a load has the size and the direction, then Young's modulus and, where the law has
    ranges, its parameters.

    Attributes:
        largest: Largest traction [Pa]; None: `deflection` decides.
    """

    largest: float | None = None

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: An attribute is out of range.
        """
        check_largest("largest", self.largest, "Pa")
        super().__post_init__()

    @property
    def given_sizes(self) -> Array | None:
        """0 and the largest traction over E, (2,) [-]."""
        return traction_sizes(self.problem.units, self.largest)

    @cached_property
    def weights(self) -> Tensor:
        """Integral of each shape function over the region, (N,) [-]."""
        areas = facet_areas(self.problem, self.facets)
        return torch.from_numpy(np.asarray(areas.sum(axis=1)).ravel())

"""Random pressures on a part of the boundary."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from dpl.fem.assembly.follower_pressure import PressureSurface
from dpl.fem.loads.combined import CombinedLoads
from dpl.fem.loads.forces import ROUNDOFF
from dpl.fem.loads.sampling import Array
from dpl.fem.loads.sized import check_range
from dpl.fem.loads.surface import SurfaceLoads


@dataclass(frozen=True, eq=False)
class FacePressure(SurfaceLoads, CombinedLoads):
    """Uniform dead pressure of random size on the whole region.

    It acts against the outward normal of the undeformed body.

    The point of a load has the size, then Young's modulus and, where the law has ranges, its
    parameters.

    Attributes:
        pressure: Smallest and largest pressure [Pa]; None: from 0, `deflection` decides.
    """

    si_options: ClassVar[tuple[str, ...]] = ("pressure",)
    pressure: Sequence[float] | None = None

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: An attribute is out of range.
        """
        check_range("pressure", self.pressure, "Pa")
        super().__post_init__()

    @property
    def given_sizes(self) -> Array | None:
        """Smallest and largest pressure over E, (2,) [-]."""
        if self.pressure is None:
            return None
        words = f"pressure = {list(self.pressure)}"
        return self.problem.units.stress(np.asarray(self.pressure, dtype=np.float64), words)

    @cached_property
    def shapes(self) -> Tensor:
        """Force of the pressure 1 on the undeformed surface, (1, N, D) [-]."""
        surface = PressureSurface.build(self.problem.basis, self.facets)
        force = -surface.force(torch.zeros(1, *self.problem.shape, dtype=torch.float64))
        return torch.where(force.abs() > ROUNDOFF * force.abs().max(), force, 0.0)

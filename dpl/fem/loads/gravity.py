"""Random accelerations of the whole body."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from torch import Tensor

from dpl.fem.loads.combined import VectorLoads
from dpl.fem.loads.forces import body_force
from dpl.fem.loads.sampling import Array
from dpl.fem.loads.sized import check_largest, check_range


@dataclass(frozen=True, eq=False)
class GravityLoads(VectorLoads):
    """Weight of the body in random directions, with accelerations of random size.

    The nodal forces are consistent: at corners of quadratic tetrahedra they act against gravity.

    The point of a load has the size and the direction, then Young's modulus and, where the law has
    ranges, its parameters.

    Attributes:
        density: Mass per rest volume [kg/m^3]; None: `deflection` decides.
        acceleration: Smallest and largest acceleration [m/s^2]; not used without `density`.
    """

    si_options: ClassVar[tuple[str, ...]] = ("density", "acceleration")
    density: float | None = None
    acceleration: Sequence[float] = (0.0, 9.81)

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: An attribute is out of range.
        """
        check_largest("density", self.density, "kg/m^3")
        check_range("acceleration", self.acceleration, "m/s^2", least=0.0)
        super().__post_init__()

    @property
    def given_sizes(self) -> Array | None:
        """Smallest and largest weight per volume times L / E, (2,) [-]."""
        if self.density is None:
            return None
        words = f"density = {self.density}"
        weight = self.density * np.asarray(self.acceleration, dtype=np.float64)
        return self.problem.units.stress_gradient(weight, words)

    @cached_property
    def weights(self) -> Tensor:
        """Integral of each shape function over the body, (N,) [-].

        Integrals at corners of quadratic tetrahedra are negative: no masses of the nodes.
        """
        return body_force(self.problem, np.ones_like)[:, 0].contiguous()

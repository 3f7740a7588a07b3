"""Families of loads on a face, in the volume and along cables: few fixed forces each."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dpl.fem.assembly.follower_cable import CableSegments
from dpl.fem.assembly.follower_loads import LoadedPart
from dpl.fem.assembly.follower_pressure import PressureSurface
from dpl.fem.loads.family import SurfaceLoads
from dpl.fem.loads.forces import ROUNDOFF, body_force, facet_areas
from dpl.fem.loads.sampling import Array
from dpl.fem.loads.sized import CombinedLoads, VectorLoads, rounded
from dpl.fem.options import option
from dpl.fem.problem import Problem
from dpl.system.checks import named_errors


@dataclass(frozen=True, eq=False)
class FaceTractions(SurfaceLoads, VectorLoads):
    """Uniform dead traction of random direction and size on the whole region.

    Attributes:
        largest: Largest traction [Pa]; None: `deflection` decides.
    """

    largest: float | None = option("Pa", default=None, above=0.0)

    @cached_property
    def weights(self) -> Tensor:
        """Integral of each shape function over the region, (N,) [-]."""
        areas = facet_areas(self.problem, self.facets)
        return torch.from_numpy(np.asarray(areas.sum(axis=1)).ravel())


@dataclass(frozen=True, eq=False)
class FacePressure(SurfaceLoads, CombinedLoads):
    """Uniform dead pressure of random size on the whole region, inwards on the undeformed body.

    Attributes:
        pressure: Smallest and largest pressure [Pa]; None: from 0, `deflection` decides.
    """

    pressure: Sequence[float] | None = option("Pa", default=None, nonzero=True)

    @cached_property
    def shapes(self) -> Tensor:
        """Force of the pressure 1 on the undeformed surface, (1, N, D) [-]."""
        return _at_rest(PressureSurface.build(self.problem.basis, self.facets), self.problem)


@dataclass(frozen=True, eq=False)
class GravityLoads(VectorLoads):
    """Weight of the body in random directions, with accelerations of random size.

    The nodal forces are consistent: at corners of quadratic tetrahedra they act against gravity.

    Attributes:
        density: Mass per rest volume [kg/m^3]; None: `deflection` decides.
        acceleration: Smallest and largest acceleration [m/s^2]; not used without `density`.
    """

    density: float | None = option("kg/m^3", default=None, above=0.0)
    acceleration: Sequence[float] = option("m/s^2", default=(0.0, 9.81), least=0.0, nonzero=True)

    @property
    def given_sizes(self) -> Array | None:
        """Smallest and largest weight per volume times L / E, (2,) [-]."""
        if self.density is None:
            return None
        weight = self.density * np.asarray(self.acceleration, dtype=np.float64)
        return self.problem.units.stress_gradient(weight, f"density = {self.density}")

    @cached_property
    def weights(self) -> Tensor:
        """Integral of each shape function over the body, (N,) [-]."""
        return body_force(self.problem, np.ones_like)[:, 0].contiguous()


@dataclass(frozen=True, eq=False)
class CableLoads(CombinedLoads):
    """Cables threaded through points of the body, each with a random tension.

    With the unit vectors t along the undeformed cable, the force on an inner point is
    T (t_next - t_previous), and on an end T towards its neighbour. These are dead loads. The shape
    functions of its cell distribute the force on a point to nodes.

    Attributes:
        cables: Points of each cable in order, two or more, D coordinates each [m].
        tension: Smallest and largest tension [N] (2D: [N/m]); None: from 0, `deflection` decides.
    """

    cables: Sequence[Sequence[Sequence[float]]]
    tension: Sequence[float] | None = option("N", default=None, least=0.0, nonzero=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.shapes  # noqa: B018  # raises if a cable is invalid

    @cached_property
    def shapes(self) -> Tensor:
        """Force of the tension 1 in each cable, (K, N, D) [-]."""
        if not self.cables:
            raise ValueError("cables = [] must contain a cable: a list of points [m]")
        shapes, problem = [], self.problem
        for number, cable in enumerate(self.cables):
            with named_errors(f"cables.{number}: "):
                place = problem.length, problem.origin
                shapes.append(_at_rest(CableSegments.build(problem.basis, cable, *place), problem))
        return torch.cat(shapes)

    def identity(self) -> dict[str, Any]:
        """Return the options; the cables are identified by their points over L."""
        corner = self.problem.origin + self.problem.points.numpy().min(axis=0)
        cables = [np.array(cable) / self.problem.length - corner for cable in self.cables]
        points = [np.round(cable, 9) + 0.0 for cable in cables]
        return super().identity() | {"cables": [[rounded(p) for p in cable] for cable in points]}


def _at_rest(part: LoadedPart, problem: Problem) -> Tensor:
    """Return the forces of a follower load on the body at rest, (1, N, D) [-]."""
    force = -part.force(torch.zeros(1, *problem.shape, dtype=torch.float64))
    return torch.where(force.abs() > ROUNDOFF * force.abs().max(), force, 0.0)

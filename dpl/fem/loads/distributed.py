"""Families of loads on a face, in the volume and along cables: few fixed forces each."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dpl.fem.assembly.follower_pressure import PressureSurface
from dpl.fem.loads.family import SurfaceLoads
from dpl.fem.loads.forces import ROUNDOFF, body_force, facet_areas
from dpl.fem.loads.sampling import Array
from dpl.fem.loads.sized import CombinedLoads, VectorLoads, rounded
from dpl.fem.options import option
from dpl.fem.problem import Problem
from dpl.system.checks import named_errors

INWARD = 1e-7  # shift of points on the surface into their cell, over the distance to its centre [-]


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
        surface = PressureSurface.build(self.problem.basis, self.facets)
        force = -surface.force(torch.zeros(1, *self.problem.shape, dtype=torch.float64))
        return torch.where(force.abs() > ROUNDOFF * force.abs().max(), force, 0.0)


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
        shapes = []
        for number in range(len(self.cables)):
            points = self._points(number)
            step = np.diff(points, axis=0)
            length = np.linalg.norm(step, axis=1, keepdims=True)
            if not (length > 0).all():
                raise ValueError(f"cables.{number} must not contain the same point twice in a row")
            pulls = np.diff(step / length, axis=0, prepend=0.0, append=0.0)
            with named_errors(f"cables.{number}: "):
                shapes.append(torch.from_numpy(shape_functions(self.problem, points).T @ pulls))
        return torch.stack(shapes)

    def _points(self, number: int) -> Array:
        """Return the points of a cable over L, (P, D)."""
        cable, dim = self.cables[number], self.problem.shape[1]
        sound = len(cable) >= 2 and all(len(point) == dim for point in cable)
        if not (sound and np.isfinite(cable).all()):
            raise ValueError(
                f"cables.{number} = {list(map(list, cable))} must be two or more points of {dim} "
                "coordinates [m]"
            )
        return np.asarray(cable, dtype=np.float64) / self.problem.length - self.problem.origin

    def identity(self) -> dict[str, Any]:
        """Return the options; the cables are identified by their points over L."""
        corner = self.problem.points.numpy().min(axis=0)
        points = [np.round(self._points(k) - corner, 9) + 0.0 for k in range(len(self.cables))]
        return super().identity() | {"cables": [[rounded(p) for p in cable] for cable in points]}


def shape_functions(problem: Problem, points: Array) -> Array:
    """Return the values of all shape functions at points (P, D) [-] of the body, (P, N)."""
    basis, mesh = problem.basis, problem.mesh
    centres = mesh.p[:, mesh.t].mean(axis=1).T  # (cells, D)
    values = np.zeros((len(points), basis.N))
    for row, point in zip(values, points, strict=True):
        centre = centres[np.linalg.norm(centres - point, axis=1).argmin()]
        inward = point + INWARD * (centre - point)
        try:
            cell = mesh.element_finder(mapping=basis.mapping)(*inward[:, None])
        except ValueError:
            place = ((point + problem.origin) * problem.length).tolist()
            raise ValueError(f"the point {place} [m] must lie in the body") from None
        local = basis.mapping.invF(point[:, None, None], tind=cell)
        for k, node in enumerate(basis.element_dofs[:, cell[0]]):
            row[node] = np.asarray(basis.elem.gbasis(basis.mapping, local, k, tind=cell)[0]).item()
    return np.where(np.abs(values) > ROUNDOFF, values, 0.0)

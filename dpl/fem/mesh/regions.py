"""Regions of a body, which select nodes and facets for boundary conditions and loads.

A region is a function that maps points (N, D) [m] to a mask (N,), or a `Tag`, the name of a part of
the mesh. `nodes_in` and `facets_in` take both.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import skfem
from numpy.typing import NDArray

SLACK = 1e-6  # geometric tolerance over the size of the body or of the region


@dataclass(frozen=True)
class Plane:
    """Region: the nodes on a plane across a coordinate axis.

    Attributes:
        axis: 0, 1 or 2 for x, y or z.
        at: Coordinate of the plane [m], or "min" or "max" for the extreme nodes of the body.

    Raises:
        ValueError: `axis` or `at` is invalid.
    """

    axis: int
    at: float | str

    def __post_init__(self) -> None:
        """Check the attributes."""
        if self.axis not in (0, 1, 2):
            raise ValueError(f"axis = {self.axis} must be 0, 1 or 2")
        if isinstance(self.at, str) and self.at not in ("min", "max"):
            raise ValueError(f"at = {self.at!r} must be min, max or a coordinate [m]")

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return a mask (N,) of the points (N, D) [m] in the region."""
        if self.axis >= points.shape[1]:
            raise ValueError(
                f"axis = {self.axis} must be less than {points.shape[1]}, the dimension"
            )
        x = points[:, self.axis]
        at = {"min": x.min(), "max": x.max()}[self.at] if isinstance(self.at, str) else self.at
        return np.abs(x - at) <= SLACK * np.ptp(points, axis=0).max()


@dataclass(frozen=True)
class Box:
    """Region: the nodes in an axis-aligned box, including its faces.

    Attributes:
        lower, upper: Opposite corners, D coordinates each [m].

    Raises:
        ValueError: A coordinate of `lower` is above that of `upper`.
    """

    lower: Sequence[float]
    upper: Sequence[float]

    def __post_init__(self) -> None:
        """Check the attributes."""
        fits = len(self.lower) == len(self.upper)
        if not fits or not all(a <= b for a, b in zip(self.lower, self.upper, strict=True)):
            raise ValueError(
                f"lower = {list(self.lower)} must not be above upper = {list(self.upper)}"
            )

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return a mask (N,) of the points (N, D) [m] in the region."""
        _check_dimension("lower", self.lower, points)
        slack = SLACK * np.ptp(points, axis=0).max()
        inside = (points >= np.array(self.lower) - slack) & (points <= np.array(self.upper) + slack)
        return inside.all(axis=1)


@dataclass(frozen=True)
class Sphere:
    """Region: the nodes in a ball, including its surface.

    Attributes:
        centre: D coordinates [m].
        radius: Radius [m].

    Raises:
        ValueError: The centre is not finite, or the radius not positive.
    """

    centre: Sequence[float]
    radius: float

    def __post_init__(self) -> None:
        """Check the attributes."""
        _check_ball("centre", self.centre, self.radius)

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return a mask (N,) of the points (N, D) [m] in the region."""
        _check_dimension("centre", self.centre, points)
        distance = np.linalg.norm(points - np.array(self.centre, dtype=np.float64), axis=1)
        return distance <= _tolerant_radius(self.radius, points)


@dataclass(frozen=True)
class Cylinder:
    """Region: the nodes in an infinite cylinder along a coordinate axis, including its surface.

    It selects the surface of a bore, inside of which there are no nodes. In 2D axis 2 gives a disc.

    Attributes:
        axis: 0, 1 or 2 for x, y or z.
        radius: Radius [m].
        centre: A point of the axis, D coordinates [m]; default: the origin.

    Raises:
        ValueError: `axis` is invalid, the centre not finite or the radius not positive.
    """

    axis: int
    radius: float
    centre: Sequence[float] | None = None

    def __post_init__(self) -> None:
        """Check the attributes."""
        if self.axis not in (0, 1, 2):
            raise ValueError(f"axis = {self.axis} must be 0, 1 or 2")
        _check_ball("centre", () if self.centre is None else self.centre, self.radius)

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return a mask (N,) of the points (N, D) [m] in the region."""
        centre = [0.0] * points.shape[1] if self.centre is None else self.centre
        _check_dimension("centre", centre, points)
        across = [i for i in range(points.shape[1]) if i != self.axis]
        distance = np.linalg.norm((points - np.array(centre, dtype=np.float64))[:, across], axis=1)
        return distance <= _tolerant_radius(self.radius, points)


@dataclass(frozen=True)
class Tag:
    """Region: a named part of the mesh; see `dpl.fem.read_mesh`.

    Attributes:
        name: A key of scikit-fem's `mesh.boundaries` (facets) or `mesh.subdomains` (cells). Facets
            take precedence.

    Raises:
        ValueError: The name is not a string, or empty.
    """

    name: str

    def __post_init__(self) -> None:
        """Check the attribute."""
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f'name = {self.name!r} must be a string; write numbers in quotes, "7"')

    def facets(self, mesh: skfem.Mesh) -> NDArray[np.int_] | None:
        """Return the facets of that name, including interior ones; None for a name of cells.

        Raises:
            ValueError: The mesh has no such name; the message lists its names.
        """
        facets, cells = mesh.boundaries or {}, mesh.subdomains or {}
        if self.name in facets:
            return np.asarray(facets[self.name])
        if self.name in cells:
            return None
        names = sorted(map(repr, {*facets, *cells}))
        more = f" and {len(names) - 20} more" if len(names) > 20 else ""
        raise ValueError(f"{self}: the mesh has {', '.join(names[:20]) or 'no tags at all'}{more}")


Origin = NDArray[np.float64] | float
Region = Callable[[NDArray[np.float64]], NDArray[np.bool_]] | Tag


def nodes_in(
    region: Region, basis: skfem.Basis, scale: float = 1.0, origin: Origin = 0.0
) -> NDArray[np.bool_]:
    """Return a mask of the nodes in a region, (N,).

    Args:
        region: The region. A `Tag` contains the nodes of its facets or cells.
        basis: scikit-fem basis of one displacement component; its N nodes include those of edges,
            faces and cells.
        scale: Length unit of the mesh of the basis [m].
        origin: Origin of that mesh in its own unit, (D,).

    Raises:
        ValueError: The region contains no node, the tag does not exist, or the region does not
            return a mask (N,).
    """
    if isinstance(region, Tag):
        inside = np.zeros(basis.N, dtype=bool)
        facets = region.facets(basis.mesh)
        if facets is None:
            inside[basis.element_dofs[:, basis.mesh.subdomains[region.name]]] = True
        elif len(facets):  # scikit-fem interprets an empty set as the whole boundary
            inside[basis.get_dofs(facets).all()] = True
    else:
        inside = _inside(region, (basis.doflocs.T + origin) * scale)
    if not inside.any():
        raise ValueError(f"{_name(region)} holds no node of the mesh")
    return inside


def facets_in(
    region: Region, mesh: skfem.Mesh, scale: float = 1.0, origin: Origin = 0.0
) -> NDArray[np.int_]:
    """Return the boundary facets in a region in ascending order.

    Args:
        region: The region. It contains the facets whose vertices all lie inside. A `Tag` contains
            its facets, or those whose vertices all belong to its cells.
        mesh: The body.
        scale: Length unit of the mesh [m].
        origin: Origin of the mesh in its own unit, (D,).

    Raises:
        ValueError: The region contains no boundary facet, the tag does not exist, or the region
            does not return a mask (N,).
    """
    boundary = mesh.boundary_facets()
    tagged = region.facets(mesh) if isinstance(region, Tag) else None
    if tagged is not None:
        facets = np.intersect1d(boundary, tagged)
    else:
        if isinstance(region, Tag):
            inside = np.zeros(mesh.p.shape[1], dtype=bool)
            inside[mesh.t[:, mesh.subdomains[region.name]]] = True
        else:
            inside = _inside(region, (mesh.p.T + origin) * scale)
        facets = boundary[inside[mesh.facets[:, boundary]].all(axis=0)]
    if not len(facets):
        raise ValueError(f"{_name(region)} holds no facet of the boundary")
    return facets


def _inside(region: Callable, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    inside = np.asarray(region(np.ascontiguousarray(points)))
    if inside.dtype != bool or inside.shape != (len(points),):
        raise ValueError(
            f"{_name(region)} returns {inside.dtype} of shape {inside.shape} and must return "
            f"bool of shape ({len(points)},)"
        )
    return inside


def _name(region: Region) -> str:
    return getattr(region, "__name__", None) or repr(region)


def _tolerant_radius(radius: float, points: NDArray[np.float64]) -> float:
    """Return a radius with tolerances for its own rounding and for that of large coordinates."""
    return radius * (1 + SLACK) + 4 * float(np.finfo(np.float64).eps * np.abs(points).max())


def _check_ball(name: str, centre: Sequence[float], radius: float) -> None:
    if not all(map(math.isfinite, centre)):
        raise ValueError(f"{name} = {list(centre)} must be finite coordinates [m]")
    if not (math.isfinite(radius) and radius > 0):
        raise ValueError(f"radius = {radius} must be a positive length [m]")


def _check_dimension(name: str, corner: Sequence[float], points: NDArray[np.float64]) -> None:
    if len(corner) != points.shape[1]:
        raise ValueError(f"{name} = {list(corner)} must have {points.shape[1]} coordinates")

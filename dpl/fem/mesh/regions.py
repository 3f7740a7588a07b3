"""Regions of a body: which nodes are held, which facets are loaded.

A region is a function of points (N, D) [m] that says which of them lie inside, (N,); or a `Tag`,
the name of a part that the mesh itself knows. `nodes_in` and `facets_in` take both.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import skfem
from numpy.typing import NDArray

SLACK = 1e-6  # rounding that regions forgive, over the size of the body or of the region


@dataclass(frozen=True)
class Plane:
    """Region: the nodes on a plane across a coordinate axis.

    Attributes:
        axis: 0, 1 or 2 for x, y or z.
        at: Where the plane cuts the axis [m], or "min" or "max" for the body's first or last node.

    Raises:
        ValueError: `axis` or `at` is none of the above.
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
        """Return which of points (N, D) [m] lie in the region, (N,)."""
        if self.axis >= points.shape[1]:
            raise ValueError(f"axis = {self.axis} does not exist in {points.shape[1]}D")
        x = points[:, self.axis]
        at = {"min": x.min(), "max": x.max()}[self.at] if isinstance(self.at, str) else self.at
        return np.abs(x - at) <= SLACK * np.ptp(points, axis=0).max()


@dataclass(frozen=True)
class Box:
    """Region: the nodes in a box along the axes, its faces included.

    Attributes:
        lower, upper: Opposite corners [m], D of them.

    Raises:
        ValueError: The corners do not span a box.
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
        """Return which of points (N, D) [m] lie in the region, (N,)."""
        _same_dimension("lower", self.lower, points)
        slack = SLACK * np.ptp(points, axis=0).max()
        inside = (points >= np.array(self.lower) - slack) & (points <= np.array(self.upper) + slack)
        return inside.all(axis=1)


@dataclass(frozen=True)
class Sphere:
    """Region: the nodes in a ball, its surface included.

    Attributes:
        centre: D coordinates [m].
        radius: [m]

    Raises:
        ValueError: The centre is not finite, or the radius not positive.
    """

    centre: Sequence[float]
    radius: float

    def __post_init__(self) -> None:
        """Check the attributes."""
        _round("centre", self.centre, self.radius)

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which of points (N, D) [m] lie in the region, (N,)."""
        _same_dimension("centre", self.centre, points)
        distance = np.linalg.norm(points - np.array(self.centre, dtype=np.float64), axis=1)
        return distance <= _reach(self.radius, points)


@dataclass(frozen=True)
class Cylinder:
    """Region: the nodes in an endless cylinder along a coordinate axis, its surface included.

    It takes hold of a bore: no node of the body lies deeper inside. In 2D axis 2 gives a disc.

    Attributes:
        axis: 0, 1 or 2 for x, y or z.
        radius: [m]
        centre: A point of the axis [m], D coordinates; the origin if left out.

    Raises:
        ValueError: `axis` is none of the above, the centre not finite or the radius not positive.
    """

    axis: int
    radius: float
    centre: Sequence[float] | None = None

    def __post_init__(self) -> None:
        """Check the attributes."""
        if self.axis not in (0, 1, 2):
            raise ValueError(f"axis = {self.axis} must be 0, 1 or 2")
        _round("centre", () if self.centre is None else self.centre, self.radius)

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which of points (N, D) [m] lie in the region, (N,)."""
        centre = [0.0] * points.shape[1] if self.centre is None else self.centre
        _same_dimension("centre", centre, points)
        across = [i for i in range(points.shape[1]) if i != self.axis]
        distance = np.linalg.norm((points - np.array(centre, dtype=np.float64))[:, across], axis=1)
        return distance <= _reach(self.radius, points)


@dataclass(frozen=True)
class Tag:
    """Region: a part that the mesh knows by name; see `dpl.fem.read_mesh`.

    Attributes:
        name: A key of scikit-fem's `mesh.boundaries` (facets) or `mesh.subdomains` (cells). Where
            both have it, facets count.

    Raises:
        ValueError: The name is no text, or empty.
    """

    name: str

    def __post_init__(self) -> None:
        """Check the attribute."""
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f'name = {self.name!r} must be a text (a number in quotes: "7")')

    def facets(self, mesh: skfem.Mesh) -> NDArray[np.int_] | None:
        """Return the facets of that name, inner ones too; None if the name is one of cells.

        Raises:
            ValueError: There is no such name; the message lists those that there are.
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
    """Return which nodes lie in a region, (N,).

    Args:
        region: Where to look. Of a `Tag`, the nodes of its facets or cells.
        basis: scikit-fem basis of one displacement component; its N nodes may be those of edges,
            faces and cells too.
        scale: [m] per unit of the basis' mesh.
        origin: Where that mesh has its origin, (D,), in its own unit.

    Raises:
        ValueError: No node lies there, there is no such tag, or the region does not answer with
            one truth value per point.
    """
    if isinstance(region, Tag):
        inside = np.zeros(basis.N, dtype=bool)
        facets = region.facets(basis.mesh)
        if facets is None:
            inside[basis.element_dofs[:, basis.mesh.subdomains[region.name]]] = True
        elif len(facets):  # scikit-fem takes an empty set for the whole boundary
            inside[basis.get_dofs(facets).all()] = True
    else:
        inside = _inside(region, (basis.doflocs.T + origin) * scale)
    if not inside.any():
        raise ValueError(f"{_name(region)} holds no node of the mesh")
    return inside


def facets_in(
    region: Region, mesh: skfem.Mesh, scale: float = 1.0, origin: Origin = 0.0
) -> NDArray[np.int_]:
    """Return the facets of the boundary that lie in a region, ascending.

    Args:
        region: Where to look: facets with all their vertices inside. Of a `Tag`, its facets, or
            those of which all vertices belong to its cells.
        mesh: The body.
        scale: [m] per unit of the mesh.
        origin: Where the mesh has its origin, (D,), in its own unit.

    Raises:
        ValueError: No facet of the boundary lies there, there is no such tag, or the region does
            not answer with one truth value per point.
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
            f"{_name(region)} gives {inside.dtype} of shape {inside.shape} "
            f"for {len(points)} points, not one truth value each"
        )
    return inside


def _name(region: Region) -> str:
    return getattr(region, "__name__", None) or repr(region)


def _reach(radius: float, points: NDArray[np.float64]) -> float:
    """Return a radius with the slack for its own rounding and for that of coordinates far away."""
    return radius * (1 + SLACK) + 4 * float(np.finfo(np.float64).eps * np.abs(points).max())


def _round(name: str, centre: Sequence[float], radius: float) -> None:
    if not all(map(math.isfinite, centre)):
        raise ValueError(f"{name} = {list(centre)} must be finite coordinates [m]")
    if not (math.isfinite(radius) and radius > 0):
        raise ValueError(f"radius = {radius} must be a positive length [m]")


def _same_dimension(name: str, corner: Sequence[float], points: NDArray[np.float64]) -> None:
    if len(corner) != points.shape[1]:
        raise ValueError(f"{name} = {list(corner)} must have {points.shape[1]} coordinates")

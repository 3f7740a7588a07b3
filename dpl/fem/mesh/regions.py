"""Regions of a body, which select nodes and facets for boundary conditions and loads.

A region is a function that maps points (N, D) [m] to a mask (N,), or the name of a group of the
mesh: a `Tag`, or a string, which means the `Tag` of that name. `nodes_in`, `facets_in` and
`cells_in` are the only functions that evaluate regions, and take all of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import skfem
from numpy.typing import NDArray

from dpl.fem.options import check_options, option
from dpl.fem.units import vector

SLACK = 1e-6  # geometric tolerance over the size of the body or of the region


@dataclass(frozen=True)
class Plane:
    """Region: the nodes on a plane across a coordinate axis.

    Attributes:
        axis: 0, 1 or 2 for x, y or z.
        at: Coordinate of the plane [m], or "min" or "max" for the extreme nodes of the body.
    """

    axis: int = option("", least=0, most=2)
    at: float | str  # type: ignore[misc]  # `option` has no default

    def __post_init__(self) -> None:
        check_options(self)
        if isinstance(self.at, str) and self.at not in ("min", "max"):
            raise ValueError(f"at = {self.at!r} must be min, max or a coordinate [m]")

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return a mask (N,) of the points (N, D) [m] in the region."""
        if self.axis >= (dim := points.shape[1]):
            raise ValueError(f"axis = {self.axis} must be less than {dim}, the dimension")
        x = points[:, self.axis]
        at = {"min": x.min(), "max": x.max()}[self.at] if isinstance(self.at, str) else self.at
        return np.abs(x - at) <= SLACK * np.ptp(points, axis=0).max()


@dataclass(frozen=True)
class Box:
    """Region: the nodes in an axis-aligned box, including its faces.

    Attributes:
        lower, upper: Opposite corners, D coordinates each [m].
    """

    lower: Sequence[float]
    upper: Sequence[float]

    def __post_init__(self) -> None:
        lower, upper = list(self.lower), list(self.upper)
        if len(lower) != len(upper) or not (np.array(lower) <= upper).all():
            raise ValueError(f"lower = {lower} must not be above upper = {upper}")

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        slack, dim = SLACK * np.ptp(points, axis=0).max(), points.shape[1]
        lower, upper = vector("lower", self.lower, dim, "m"), vector("upper", self.upper, dim, "m")
        return ((points >= lower - slack) & (points <= upper + slack)).all(axis=1)


@dataclass(frozen=True)
class Sphere:
    """Region: the nodes in a ball, including its surface.

    Attributes:
        centre, radius: D coordinates, and a length [m].
    """

    centre: Sequence[float]
    radius: float = option("m", above=0.0)

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return _in_ball(points, self.centre, self.radius, range(points.shape[1]))


@dataclass(frozen=True)
class Cylinder:
    """Region: the nodes in an infinite cylinder along a coordinate axis, including its surface.

    It selects the surface of a bore, inside of which there are no nodes. In 2D axis 2 gives a disc.

    Attributes:
        axis: 0, 1 or 2 for x, y or z.
        radius: Radius [m].
        centre: A point of the axis, D coordinates [m]; default: the origin.
    """

    axis: int = option("", least=0, most=2)
    radius: float = option("m", above=0.0)
    centre: Sequence[float] | None = None

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        centre = [0.0] * points.shape[1] if self.centre is None else self.centre
        across = [i for i in range(points.shape[1]) if i != self.axis]
        return _in_ball(points, centre, self.radius, across)


@dataclass(frozen=True)
class Tag:
    """Region: a named part of the mesh; see `dpl.fem.read_mesh`.

    Attributes:
        name: A key of scikit-fem's `mesh.boundaries` (facets) or `mesh.subdomains` (cells). Facets
            take precedence.
    """

    name: str

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f'name = {self.name!r} must be a string; write numbers in quotes, "7"')

    def facets(self, mesh: skfem.Mesh) -> NDArray[np.int_] | None:
        """Return the facets of that name, including interior ones; None for a name of cells."""
        facets, cells = mesh.boundaries or {}, mesh.subdomains or {}
        if self.name in facets:
            return np.asarray(facets[self.name])
        if self.name in cells:
            return None
        names = list(map(repr, group_names(mesh)))
        more = f" and {len(names) - 20} more" if len(names) > 20 else ""
        known = f": {', '.join(names[:20])}{more}" if names else ", which has none"
        raise ValueError(f"{self.name!r} must be a group of the mesh{known}")


def group_names(mesh: skfem.Mesh) -> list[str]:
    """Return the names of the groups of a mesh, those of the user before values of fields.

    Groups that Gmsh numbers itself (`gmsh:geometrical=4`) are left out if there are others.
    """
    names = sorted({*(mesh.boundaries or {}), *(mesh.subdomains or {})})
    names.sort(key=lambda name: "=" in name)
    return [name for name in names if not name.startswith("gmsh:")] or names


Origin = NDArray[np.float64] | float
Points = Callable[[NDArray[np.float64]], NDArray[np.bool_]]
Region = Points | Tag | str


def nodes_in(
    region: Region, basis: skfem.Basis, scale: float = 1.0, origin: Origin = 0.0
) -> NDArray[np.bool_]:
    """Return a mask of the nodes in a region, (N,).

    Args:
        region: The region. A group contains the nodes of its facets or cells.
        basis: scikit-fem basis of one displacement component; its N nodes include those of edges,
            faces and cells.
        scale: Length unit of the mesh of the basis [m].
        origin: Origin of that mesh in its own unit, (D,).
    """
    region = Tag(region) if isinstance(region, str) else region
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
    """Return the numbers of the boundary facets in a region, ascending.

    A region contains the facets whose vertices all lie inside. A group contains its facets, or
    those whose vertices all belong to its cells. For arguments see `nodes_in`.
    """
    region, boundary = Tag(region) if isinstance(region, str) else region, mesh.boundary_facets()
    if not isinstance(region, Tag):
        inside = _inside(region, (mesh.p.T + origin) * scale)[mesh.facets[:, boundary]].all(axis=0)
    elif (tagged := region.facets(mesh)) is not None:
        inside = np.isin(boundary, tagged)
    else:
        vertices = mesh.t[:, mesh.subdomains[region.name]]
        inside = np.isin(mesh.facets[:, boundary], vertices).all(axis=0)
    facets = boundary[inside]
    if not len(facets):
        raise ValueError(f"{_name(region)} holds no facet of the boundary")
    return facets


def cells_in(
    region: Region, mesh: skfem.Mesh, scale: float = 1.0, origin: Origin = 0.0
) -> NDArray[np.int_]:
    """Return the numbers of the cells in a region, ascending.

    A region contains the cells whose centres, the means of the vertices, lie inside. A group
    contains its cells; one of facets is an error. For arguments see `nodes_in`.
    """
    region = Tag(region) if isinstance(region, str) else region
    if isinstance(region, Tag):
        if region.name not in (mesh.subdomains or {}):
            region.facets(mesh)  # raises if the mesh has no such name
            raise ValueError(f"{_name(region)} names facets and must name cells")
        cells = np.sort(np.asarray(mesh.subdomains[region.name]))
    else:
        centres = mesh.p[:, mesh.t].mean(axis=1).T
        cells = np.flatnonzero(_inside(region, (centres + origin) * scale))
    if not len(cells):
        raise ValueError(f"{_name(region)} holds no cell of the mesh")
    return cells


def _inside(region: Points, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    inside = np.asarray(region(np.ascontiguousarray(points)))
    if inside.dtype != bool or inside.shape != (len(points),):
        raise ValueError(
            f"{_name(region)} returns {inside.dtype} of shape {inside.shape} and must return "
            f"bool of shape ({len(points)},)"
        )
    return inside


def _name(region: Points | Tag) -> str:
    return getattr(region, "__name__", None) or repr(getattr(region, "name", region))


def _in_ball(
    points: NDArray[np.float64], centre: Sequence[float], radius: float, axes: Sequence[int]
) -> NDArray[np.bool_]:
    """Return a mask (N,) of the points (N, D) at most a radius from a centre along some axes."""
    away = (points - vector("centre", centre, points.shape[1], "m"))[:, list(axes)]
    # tolerances for the rounding of the radius and for that of large coordinates
    slack = radius * SLACK + 4 * np.finfo(np.float64).eps * np.abs(points).max()
    return np.linalg.norm(away, axis=1) <= radius + slack

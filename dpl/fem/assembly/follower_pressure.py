"""Follower pressure: a force along the current normal on the current area of a boundary part."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.assembly.elements import QUADRATIC
from dpl.fem.assembly.follower_loads import FollowerLoad, LoadedPart, Stress
from dpl.fem.materials.material import Material
from dpl.fem.mesh.regions import Origin, Region, facets_in
from dpl.fem.units import Units

# shape of the facets -> polynomial degree of N x,1 x x,2 for shape functions of degree 1 and 2
DEGREES = {"RefLine": (1, 3), "RefTri": (1, 4), "RefQuad": (2, 5)}


@dataclass(frozen=True)
class FollowerPressure(FollowerLoad):
    """Pressure of a fluid on a part of the boundary; it follows the deformation.

    The traction on the deformed surface is -p n, with the outward normal n of the deformed body.

    Attributes:
        region: The boundary facets.
        value: p [Pa], positive if it pushes on the body; or a range [low, high], of which each load
            has its own p, see `Problem.parameter_ranges`. On a problem with E = 1 Pa, the default
            of `Problem.build`, this is p / E.
        name: Name of the parameter of a range; "pressure" if left out.
    """

    default_name: ClassVar[str] = "pressure"
    direction_hint: ClassVar[str] = "a pressure has no direction"
    region: Region
    value: Stress
    name: str | None = None

    def on(
        self, basis: skfem.Basis, units: Units, material: Material, origin: Origin = 0.0
    ) -> "PressureSurface":
        """Return the loaded surface, see `FollowerLoad.on`."""
        facets = facets_in(self.region, basis.mesh, units.length, origin)
        return PressureSurface.build(basis, facets)


@dataclass(frozen=True, eq=False)
class PressureSurface(LoadedPart):
    """Boundary facets under the follower pressure p = E.

    The area vector of a deformed facet is y1 x y2, with the derivatives y_i = t_i + du/dxi_i of the
    positions along the coordinates xi_i of the reference facet. It is a polynomial of the nodal
    positions on the facet, which the quadrature integrates exactly. In 2D the second tangent is a
    unit vector across the plane, which does not deform. Points need no inverse mapping, which
    scikit-fem does not find in all curved cells.

    Source: Bonet, Wood (2008), Nonlinear Continuum Mechanics for Finite Element Analysis, section
    8.5 (load stiffness of enclosed boundaries); Schweizerhof, Ramm (1984), Comput. Struct. 18.

    Attributes:
        weights: Shape functions times weights of the quadrature points, (S, Q, A) [-].
        slopes: Derivatives of the shape functions along xi_1 and xi_2, (S, Q, A, 2) [-].
        tangents: Derivatives t_i of the positions at rest, (S, Q, 3, 2) [-]; t1 x t2 points out of
            the body.
    """

    kind: ClassVar[str] = "follower pressure"
    key = "pressure"
    extent: ClassVar[str] = "on {:,} facets"
    weights: Tensor
    slopes: Tensor
    tangents: Tensor

    @classmethod
    def build(cls, basis: skfem.Basis, facets: NDArray[np.int_]) -> Self:
        """Return the surface of boundary facets (S,)."""
        mesh = basis.mesh
        cells = mesh.f2t[0, facets]
        side = (mesh.t2f[:, cells] == facets).argmax(axis=0)  # number of the facet in its cell
        rules = [_facet_rule(basis, local) for local in range(len(mesh.t2f))]
        nodes, weights, slopes, sense = (np.stack(part)[side] for part in zip(*rules, strict=True))
        nodes = np.take_along_axis(basis.element_dofs[:, cells].T, nodes, axis=1)
        X = np.zeros((*nodes.shape, 3))
        X[..., : mesh.dim()] = basis.doflocs.T[nodes]
        tangents = np.einsum("sqai,sac->sqci", slopes, X)
        if mesh.dim() == 2:
            tangents[..., 2, 1] = 1.0
        centre = mesh.elem.refdom.p.mean(axis=1)[:, None]
        J = mesh.mapping().detDF(centre, tind=cells)
        outward = (sense[:, None] * np.sign(J))[:, None]
        tangents[..., 1] *= outward
        slopes[..., 1] *= outward
        return cls(
            nodes=torch.from_numpy(nodes.astype(np.int64)),
            weights=torch.from_numpy(np.ascontiguousarray(weights)),
            slopes=torch.from_numpy(np.ascontiguousarray(slopes)),
            tangents=torch.from_numpy(tangents),
        )

    def force(self, displacement: Tensor) -> Tensor:
        """Return dV/du, minus the nodal forces of the pressure, (B, N, D) [-]."""
        first, second = (self.tangents + self._slopes(displacement)).unbind(-1)
        return self._sum_of_normals(torch.linalg.cross(first, second), displacement)

    def work(self, displacement: Tensor) -> Tensor:
        """Return the volume between the surface at rest and the deformed one, (B,) [-].

        There is a potential if the surface is closed, or if its edge is fixed or remains in planes.
        """
        slopes = self._slopes(displacement)
        (t1, t2), (h1, h2) = self.tangents.unbind(-1), slopes.unbind(-1)
        cross = torch.linalg.cross
        t1, t2 = t1.expand_as(h1), t2.expand_as(h2)
        normal = cross(t1, t2) + (cross(t1, h2) + cross(h1, t2)) / 2 + cross(h1, h2) / 3
        return (self._sum_of_normals(normal, displacement) * displacement).sum((-2, -1))

    def stiffness(self, displacement: Tensor) -> list[Tensor]:
        """Return the entries of both parts for all pairs of a facet, (B, S (A D)^2) [-] each.

        The block of the nodes a and b has the entries epsilon_ikl c_l. In the skew part the blocks
        of neighbouring facets cancel, so that only the edge of the surface is left.
        """
        dim = displacement.shape[-1]
        y1, y2 = (self.tangents + self._slopes(displacement)).unbind(-1)  # (B, S, Q, 3)
        first, second = self._pair_weights
        c = (first @ y2 - second @ y1).unflatten(2, (self.nodes.shape[1], -1))  # (B, S, A, A, 3)
        unit = torch.eye(3).to(c).expand(*c.shape, 3)
        crossed = torch.linalg.cross(c[..., None, :], unit)  # rows i, columns k
        matrices = crossed[..., :dim, :dim].transpose(3, 4).flatten(4, 5).flatten(2, 3)
        return [((matrices + sign * matrices.mT) / 2).flatten(1) for sign in (1.0, -1.0)]

    @cached_property
    def _pair_weights(self) -> tuple[Tensor, Tensor]:
        """Weights of node a times slopes of node b along xi_i, (S, A A, Q) each."""
        weights, slopes = self.weights.mT[:, :, None], self.slopes.permute(3, 0, 2, 1)
        first, second = (weights * slopes[:, :, None]).flatten(2, 3)
        return first, second

    def _slopes(self, displacement: Tensor) -> Tensor:
        """Return du/dxi_i at the quadrature points, (B, S, Q, 3, 2) [-]; in 2D with zeros."""
        at_facets = displacement[:, self.nodes]
        at_facets = torch.nn.functional.pad(at_facets, (0, 3 - at_facets.shape[-1]))
        slopes = self.slopes.transpose(2, 3).flatten(1, 2) @ at_facets  # (B, S, 2 Q, 3)
        return slopes.unflatten(2, (-1, 2)).mT

    def _sum_of_normals(self, normal: Tensor, displacement: Tensor) -> Tensor:
        """Return the nodal forces (B, N, D) of normals (B, S, Q, 3)."""
        forces = self.weights.mT @ normal[..., : displacement.shape[-1]]
        return self._sum_at_nodes(forces, displacement)


def _facet_rule(
    basis: skfem.Basis, local: int
) -> tuple[NDArray[np.int_], NDArray[np.float64], NDArray[np.float64], float]:
    """Return numbers of nodes, weights, slopes and the sense of a facet of the reference cell.

    They are the numbers (A,) of the nodes in the cell, the shape functions times the weights of the
    quadrature (Q, A), their derivatives along the edges (Q, A, 2), and 1 where the product of the
    edges points out of the cell, else -1.
    """
    element, cell = basis.elem, basis.mesh.elem.refdom
    order = DEGREES[cell.brefdom.__name__][type(element) in QUADRATIC]
    points, weights = skfem.quadrature.get_quadrature(cell.brefdom, order)
    corners = cell.p[:, cell.facets[local]].astype(np.float64)
    first = corners[:, :1]
    edges = (corners[:, [1, -1]] - first)[:, : len(first) - 1]
    at = first + edges @ points
    shapes = [element.lbasis(at, a) for a in range(basis.Nbfun)]
    values = np.stack([np.broadcast_to(value, weights.shape) for value, _ in shapes], axis=-1)
    slopes = np.zeros((*values.shape, 2))
    for a, (_, gradient) in enumerate(shapes):
        slopes[:, a, : len(at) - 1] = np.broadcast_to(gradient, at.shape).T @ edges
    # nodes of a facet are those whose shape functions do not vanish on it
    on = np.flatnonzero(np.abs(values).max(axis=0) > 1e-12)
    sense = np.sign(np.linalg.det(np.hstack([edges, first - cell.p.mean(axis=1)[:, None]])))
    # in 2D the second tangent is normal to the plane: t1 x e_z is t1, turned clockwise
    sense = sense if len(at) == 3 else -sense
    return on, values[:, on] * weights[:, None], slopes[:, on], sense

"""Follower cable: a tendon through points of a body, which pulls along its deformed segments."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.assembly.follower_loads import FollowerLoad, LoadedPart, Stress
from dpl.fem.materials.material import Material
from dpl.fem.mesh.regions import Origin
from dpl.fem.units import Units

INWARD = 1e-7  # shift of points on the surface into their cell, over the distance to its centre [-]
ROUNDOFF = 1e-9  # shape functions below this are 0, so that a point near a node is the node


@dataclass(frozen=True)
class FollowerCable(FollowerLoad):
    """Tension of a cable that slides without friction through points of the body.

    The cable is straight between its points, also where it leaves the body. The tension is the same
    along the cable: its potential is T times the length of the deformed cable. The ends of the
    cable are attached to the body.

    Source: Coevoet et al. (2017), Adv. Robot. 31, "Software toolkit for modeling, simulation and
    control of soft robots" (cables through points).

    Attributes:
        points: Points of the undeformed body in order, two or more, D coordinates each [m].
        value: T [N] (2D: [N/m]), positive if it pulls; or a range [low, high], of which each load
            has its own T, see `Problem.parameter_ranges`. On a problem with E = 1 Pa, the default
            of `Problem.build`, this is T / E [m^2].
        name: Name of the parameter of a range; "tension" if left out.
    """

    default_name: ClassVar[str] = "tension"
    direction_hint: ClassVar[str] = "it acts along the cable, see points"
    unit: ClassVar[str] = "N"
    points: Sequence[Sequence[float]]
    value: Stress
    name: str | None = None

    def on(
        self, basis: skfem.Basis, units: Units, material: Material, origin: Origin = 0.0
    ) -> "CableSegments":
        """Return the segments of the cable, see `FollowerLoad.on`."""
        return CableSegments.build(basis, self.points, units.length, origin)


@dataclass(frozen=True, eq=False)
class CableSegments(LoadedPart):
    """Straight segments of a cable under the tension T = E L^(D - 1).

    The vector d = d_0 + sum_a s_a u_a of a segment is linear in the displacements: s_a is the shape
    function of node a at the end of the segment minus that at its start. With l = |d| and t = d / l
    the force is T s_a t, and its derivative the blocks T s_a s_b (I - t t^T) / l.

    Attributes:
        slopes: Differences s_a, (S, A) [-].
        segments: Vectors d_0 at rest, (S, D) [-].
        length: L, () [m].
    """

    kind: ClassVar[str] = "follower cable"
    extent: ClassVar[str] = "of {:,} segments"
    slopes: Tensor
    segments: Tensor
    length: Tensor

    @classmethod
    def build(
        cls, basis: skfem.Basis, points: Sequence[Sequence[float]], length: float, origin: Origin
    ) -> Self:
        """Return the segments between points [m] of a body; L and origin as in `nodes_in`."""
        dim = basis.mesh.dim()
        sound = len(points) >= 2 and all(len(point) == dim for point in points)
        if not (sound and np.isfinite(points).all()):
            words = f"points = {list(map(list, points))}"
            raise ValueError(f"{words} must be two or more points of {dim} coordinates [m]")
        if not np.diff(np.asarray(points), axis=0).any(axis=1).all():
            raise ValueError(
                f"points = {list(map(list, points))} must not contain the same point twice in a row"
            )
        at = np.asarray(points, dtype=np.float64) / length - origin
        pairs = [_shape_functions(basis, x, length, origin) for x in at]
        nodes, values = (np.stack(part) for part in zip(*pairs, strict=True))  # (P, A)
        nodes = np.hstack([nodes[:-1], nodes[1:]])
        slopes = np.hstack([-values[:-1], values[1:]])
        used = np.argsort(slopes == 0, axis=1, kind="stable")  # zeros last
        used = used[:, : np.count_nonzero(slopes, axis=1).max()]
        nodes, slopes = (np.take_along_axis(x, used, axis=1) for x in (nodes, slopes))
        return cls(
            nodes=torch.from_numpy(nodes.astype(np.int64)),
            slopes=torch.from_numpy(slopes),
            segments=torch.from_numpy(np.einsum("sa,sad->sd", slopes, basis.doflocs.T[nodes])),
            length=torch.tensor(length, dtype=torch.float64),
        )

    @property
    def key(self) -> str:
        return f"cable_{self.nodes.shape[1]}"  # cables with equally many nodes are concatenated

    @property
    def unit(self) -> str:
        return "N" if self.segments.shape[1] == 3 else "N/m"

    @property
    def scale(self) -> float:
        return float(self.length) ** (1 - self.segments.shape[1])

    @property
    def directions(self) -> Tensor:
        return self.slopes

    @property
    def links(self) -> Tensor:
        return torch.stack(
            torch.broadcast_tensors(self.nodes[:, :, None], self.nodes[:, None]), dim=-1
        ).flatten(0, 2)

    def force(self, displacement: Tensor) -> Tensor:
        """Return minus the nodal forces of the cable, (B, N, D) [-]."""
        d = self.segments + self._change(displacement)
        t = d / d.norm(dim=-1, keepdim=True)
        return self._sum_at_nodes(self.slopes[..., None] * t[:, :, None], displacement)

    def work(self, displacement: Tensor) -> Tensor:
        """Return the change of length of the cable, the potential, (B,) [-]."""
        change, rest = self._change(displacement), self.segments
        length = (rest + change).norm(dim=-1) + rest.norm(dim=-1)
        return (((2 * rest + change) * change).sum(-1) / length).sum(-1)

    def stiffness(self, displacement: Tensor) -> list[Tensor]:
        """Return the entries for all pairs of a segment, (B, S (A D)^2) [-]; no skew part."""
        d = self.segments + self._change(displacement)
        length = d.norm(dim=-1)[..., None, None]
        t = d[..., None] / length
        across = (torch.eye(d.shape[-1]).to(d) - t * t.mT) / length
        entries = torch.einsum("sa,sb,zsij->zsaibj", self.slopes, self.slopes, across)
        return [entries.flatten(1)]

    def _change(self, displacement: Tensor) -> Tensor:
        """Return d - d_0, (B, S, D) [-]."""
        return (self.slopes[:, None] @ displacement[:, self.nodes])[:, :, 0]


def _shape_functions(
    basis: skfem.Basis, point: NDArray[np.float64], length: float, origin: Origin
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the nodes, (A,), and shape functions, (A,), of a cell that contains a point (D,)."""
    mesh = basis.mesh
    centres = mesh.p[:, mesh.t].mean(axis=1).T  # (cells, D)
    centre = centres[np.linalg.norm(centres - point, axis=1).argmin()]
    inward = point + INWARD * (centre - point)
    try:
        cell = mesh.element_finder(mapping=basis.mapping)(*inward[:, None])
    except ValueError:
        place = ((point + origin) * length).tolist()
        raise ValueError(f"the point {place} [m] must lie in the body") from None
    local = basis.mapping.invF(point[:, None, None], tind=cell)
    shapes = [
        np.asarray(basis.elem.gbasis(basis.mapping, local, k, tind=cell)[0]).item()
        for k in range(basis.Nbfun)
    ]
    values = np.where(np.abs(shapes) > ROUNDOFF, shapes, 0.0)
    return basis.element_dofs[:, cell[0]], values / values.sum()

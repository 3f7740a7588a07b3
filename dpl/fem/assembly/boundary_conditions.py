"""Boundary conditions: prescribed displacements, elastic foundations, and what they constrain."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from scipy.linalg import qr
from torch import Tensor

from dpl.fem.assembly.sparsity import Pattern
from dpl.fem.mesh.regions import Origin, Region, facets_in, nodes_in
from dpl.fem.units import Units


@dataclass(frozen=True)
class DirichletBC:
    """Dirichlet condition u = g; load stepping scales g with the load.

    Attributes:
        region: The nodes.
        value: g per component [m]; None leaves the component free. Default: 0 for all components.
    """

    region: Region
    value: Sequence[float | None] | None = None

    def dimensionless(self, dim: int, units: Units) -> NDArray[np.float64]:
        """Return g / L, (D,) [-], NaN where a component is free."""
        value = [0.0] * dim if self.value is None else list(self.value)
        given = [math.nan if g is None else units.displacement(float(g)) for g in value]
        if len(given) != dim or all(map(math.isnan, given)) or any(map(math.isinf, given)):
            raise ValueError(f"value = {value} must be {dim} lengths [m]; write null where free")
        return np.array(given)

    def on(self, basis: skfem.Basis, units: Units, origin: Origin = 0.0) -> NDArray[np.float64]:
        """Return g / L, (N, D) [-], NaN where a component is free.

        The coordinates of the scalar basis are those from `origin` (D,), divided by L.
        """
        given = self.dimensionless(basis.mesh.dim(), units)
        where = nodes_in(self.region, basis, units.length, origin)
        return np.where(where[:, None], given, math.nan)


@dataclass(frozen=True)
class RobinBC:
    """Robin condition: an elastic foundation (Winkler) with the traction -alpha u.

    Attributes:
        region: The boundary facets.
        stiffness: alpha [N/m^3], one number or one per direction.
    """

    region: Region
    stiffness: float | Sequence[float]

    def dimensionless(self, dim: int, units: Units) -> NDArray[np.float64]:
        """Return alpha L / E, (D,) [-]."""
        words = f"stiffness = {self.stiffness}"
        one = isinstance(self.stiffness, int | float)
        stiffness = np.array([self.stiffness] * dim if one else self.stiffness, dtype=np.float64)
        allowed = np.isfinite(stiffness).all() and (stiffness >= 0).all() and stiffness.any()
        if stiffness.shape != (dim,) or not allowed:
            raise ValueError(
                f"{words} must be a positive number [N/m^3], or {dim} numbers from 0, one for each "
                "direction and not all 0"
            )
        return units.stress_gradient(stiffness, words)

    def on(self, basis: skfem.Basis, units: Units, origin: Origin = 0.0) -> "FoundationMatrix":
        """Return the stiffness matrix over E L^(D - 2); arguments as in `DirichletBC.on`."""
        stiffness = self.dimensionless(basis.mesh.dim(), units)
        facets = facets_in(self.region, basis.mesh, units.length, origin)
        boundary = skfem.FacetBasis(basis.mesh, basis.elem, facets=facets, intorder=4)
        mass = skfem.BilinearForm(lambda u, v, _: u * v).assemble(boundary).tocoo()
        linked = np.abs(mass.data) > 1e-14 * np.abs(mass.data).max()
        return FoundationMatrix(
            torch.from_numpy(mass.row[linked].astype(np.int64)),
            torch.from_numpy(mass.col[linked].astype(np.int64)),
            torch.from_numpy(np.outer(mass.data[linked], stiffness)),
        )


class FoundationMatrix(NamedTuple):
    """Stiffness matrix of an elastic foundation in coordinate format, diagonal in the directions.

    Attributes:
        rows, columns: Nodes of each entry, (S,).
        stiffness: Entries over E L^(D - 2) per direction, (S, D) [-].
    """

    rows: Tensor
    columns: Tensor
    stiffness: Tensor

    def force(self, displacement: Tensor) -> Tensor:
        """Return the internal forces (B, N, D) of the foundation at displacements (B, N, D)."""
        pull = self.stiffness * displacement[:, self.columns]
        return torch.zeros_like(displacement).index_add(1, self.rows, pull)

    def work(self, displacement: Tensor) -> Tensor:
        """Return the energy, half of force times displacement, (B,) [-]."""
        return (self.force(displacement) * displacement).sum((-2, -1)) / 2

    def entries(self, pattern: Pattern) -> Tensor:
        """Return the entries of the matrix on a pattern, (nnz,) [-]."""
        rows, columns, stiffness = (part.cpu().numpy() for part in self)
        places = pattern.positions(pattern.number[rows], pattern.number[columns])
        added = np.bincount(places.ravel(), stiffness.ravel(), len(pattern.indices) + 1)
        return torch.from_numpy(added[:-1]).to(self.stiffness.device)


Support = DirichletBC | RobinBC


def assemble_constraints(
    basis: skfem.Basis,
    units: Units,
    supports: Sequence[Support],
    *,
    origin: Origin = 0.0,
    fixed: Region | NDArray[np.bool_] | None = None,
    prescribed: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], FoundationMatrix | None]:
    """Return g / L, (N, D) [-], NaN where free, and the matrix of the foundations.

    `fixed` are further fixed nodes, a region or a mask (N,) or (N, D), and `prescribed` is their
    displacement over L, (N, D) [-], zero if left out. For `basis` and `origin` see
    `DirichletBC.on`.
    """
    shape = basis.N, basis.mesh.dim()
    given = np.full(shape, np.nan)
    if fixed is not None:
        where = (
            fixed if isinstance(fixed, np.ndarray) else nodes_in(fixed, basis, units.length, origin)
        )
        if not where.any():
            words = "mask" if isinstance(fixed, np.ndarray) else f"{fixed}"
            raise ValueError(f"fixed = {words} must contain a node of the mesh")
        everywhere = np.broadcast_to(where[:, None] if where.ndim == 1 else where, shape)
        given = np.where(everywhere, 0.0 if prescribed is None else prescribed, np.nan)
    for support in supports:
        if isinstance(support, DirichletBC):
            value = support.on(basis, units, origin)
            given = np.where(np.isnan(value), given, value)
    springs = [s.on(basis, units, origin) for s in supports if isinstance(s, RobinBC)]
    total = FoundationMatrix(*map(torch.cat, zip(*springs, strict=True))) if springs else None
    return given, total


def rigid_body_modes(points: Tensor) -> tuple[Tensor, list[str]]:
    """Return the rigid body modes of points (N, D), (N, D, 3 in 2D or 6), and their names."""
    points = points - points.mean(dim=0)
    dim = points.shape[1]
    motions, names = [], []
    for axis in range(dim):
        motions.append(torch.eye(dim, dtype=points.dtype)[axis].expand_as(points))
        names.append(f"translation along {'xyz'[axis]}")
    for i, j in [(1, 2), (0, 2), (0, 1)] if dim == 3 else [(0, 1)]:
        rotation = torch.zeros_like(points)
        rotation[:, i], rotation[:, j] = -points[:, j], points[:, i]
        motions.append(rotation)
        names.append(f"rotation about {'xyz'[3 - i - j]}")
    return torch.stack(motions, dim=-1), names


def unconstrained_modes(
    points: Tensor, free: Tensor, springs: FoundationMatrix | None
) -> list[str]:
    """Return the names of the rigid body modes that the boundary conditions do not constrain.

    `points` are the nodes (N, D), `free` is the mask of the free degrees of freedom (N, D).
    """
    motions, names = rigid_body_modes(points)
    fixed = motions[~free].numpy()  # (fixed degrees of freedom, motions)
    gram = fixed.T @ fixed
    if springs is not None:
        pull = springs.force(motions.movedim(-1, 0)).flatten(1)
        bed = (pull @ motions.flatten(0, 1)).numpy()
        gram = gram + bed / max(float(springs.stiffness.max()), 1e-300)
    if not gram.any():
        return names
    values, vectors = np.linalg.eigh(gram)
    null = vectors[:, values < 1e-14 * max(1.0, values.max())]
    if not null.size:
        return []
    _, pivots = qr(null.T, mode="r", pivoting=True)  # motions that span the null space
    return [names[k] for k in np.sort(pivots[: null.shape[1]])]

"""Boundary conditions: prescribed displacements and elastic foundations, each on a region."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

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

        Args:
            basis: Scalar basis of a body, its coordinates divided by L.
            units: L and E.
            origin: Origin of these coordinates, (D,) [-].
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

    Args:
        basis: Scalar basis of a body, its coordinates divided by L.
        units: L and E.
        supports: Boundary conditions.
        origin: Origin of these coordinates, (D,) [-].
        fixed: Further fixed nodes, as a region or as a mask (N,) or (N, D).
        prescribed: Displacement of `fixed` over L, (N, D) [-]; default: zero.

    Raises:
        ValueError: A region is empty, or a boundary condition does not fit the body.
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

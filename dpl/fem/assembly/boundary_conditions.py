"""What holds a body: prescribed displacements and springs, each on a region."""

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


@dataclass(frozen=True)
class DirichletBC:
    """Dirichlet condition u = g, ramped with the load.

    Attributes:
        region: Which nodes.
        value: g per component [m]; None leaves the component free. All 0 if left out: a clamp.
    """

    region: Region
    value: Sequence[float | None] | None = None

    def on(self, basis: skfem.Basis, scale: float, origin: Origin = 0.0) -> NDArray[np.float64]:
        """Return g over `scale`, (N, D) [-], NaN where it leaves a component free.

        Args:
            basis: Scalar basis of a body whose coordinates are over `scale`.
            scale: L [m].
            origin: Where these coordinates have their origin, (D,) [-].

        Raises:
            ValueError: The region holds no node, or `value` has not D entries, one of them given.
        """
        dim = basis.mesh.dim()
        value = [0.0] * dim if self.value is None else list(self.value)
        given = [math.nan if g is None else float(g) / scale for g in value]
        if len(given) != dim or all(map(math.isnan, given)) or any(map(math.isinf, given)):
            raise ValueError(f"value = {value} must be {dim} lengths [m], null where free")
        where = nodes_in(self.region, basis, scale, origin)
        return np.where(where[:, None], np.array(given), math.nan)


@dataclass(frozen=True)
class RobinBC:
    """Robin condition: a bed of springs that pulls with the traction -alpha u.

    Attributes:
        region: Which boundary facets.
        stiffness: alpha over Young's modulus [1/m], a number or one per direction. A spring whose
            alpha is fixed [Pa/m] thus stands for one Young's modulus only.
    """

    region: Region
    stiffness: float | Sequence[float]

    def on(self, basis: skfem.Basis, scale: float, origin: Origin = 0.0) -> "FoundationMatrix":
        """Return the springs' matrix over E L^(D - 2), see `DirichletBC.on`.

        Raises:
            ValueError: The region holds no boundary facet, or `stiffness` is out of range.
        """
        dim = basis.mesh.dim()
        one = isinstance(self.stiffness, int | float)
        stiffness = np.array([self.stiffness] * dim if one else self.stiffness, dtype=np.float64)
        if stiffness.shape != (dim,) or not (stiffness >= 0).all() or not stiffness.any():
            raise ValueError(
                f"stiffness = {self.stiffness} must be a number above 0 [1/m], or {dim} of them"
            )
        facets = facets_in(self.region, basis.mesh, scale, origin)
        boundary = skfem.FacetBasis(basis.mesh, basis.elem, facets=facets, intorder=4)
        mass = skfem.BilinearForm(lambda u, v, _: u * v).assemble(boundary).tocoo()
        linked = np.abs(mass.data) > 1e-14 * np.abs(mass.data).max()
        return FoundationMatrix(
            torch.from_numpy(mass.row[linked].astype(np.int64)),
            torch.from_numpy(mass.col[linked].astype(np.int64)),
            torch.from_numpy(np.outer(mass.data[linked], stiffness * scale)),
        )


class FoundationMatrix(NamedTuple):
    """Matrix of springs: one between each two linked nodes, per direction.

    Attributes:
        rows, columns: The nodes, (S,).
        stiffness: Over E L^(D - 2), (S, D) [-].
    """

    rows: Tensor
    columns: Tensor
    stiffness: Tensor

    def force(self, displacement: Tensor) -> Tensor:
        """Return the forces (B, N, D) that hold the springs at displacements (B, N, D)."""
        pull = self.stiffness * displacement[:, self.columns]
        return torch.zeros_like(displacement).index_add(1, self.rows, pull)


Support = DirichletBC | RobinBC


def concatenate_foundations(springs: Sequence[FoundationMatrix]) -> FoundationMatrix | None:
    """Return several beds as one, None if there are none."""
    return FoundationMatrix(*map(torch.cat, zip(*springs, strict=True))) if springs else None


def assemble_constraints(
    basis: skfem.Basis,
    scale: float,
    supports: Sequence[Support],
    *,
    origin: Origin = 0.0,
    fixed: Region | NDArray[np.bool_] | None = None,
    prescribed: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], FoundationMatrix | None]:
    """Return g over `scale`, (N, D) [-], NaN where free, and the springs; arguments as in a build.

    Args:
        basis: Scalar basis of a body whose coordinates are over `scale`.
        scale: L [m].
        supports: What holds it.
        origin: Where these coordinates have their origin, (D,) [-].
        fixed: What is clamped besides.
        prescribed: Displacement of that over `scale`, (N, D) [-]; zero if left out.

    Raises:
        ValueError: A region is empty, or a support is none for this body.
    """
    shape = basis.N, basis.mesh.dim()
    given = np.full(shape, np.nan)
    if fixed is not None:
        where = fixed if isinstance(fixed, np.ndarray) else nodes_in(fixed, basis, scale, origin)
        if not where.any():
            raise ValueError(f"{fixed} holds no node of the mesh")
        everywhere = np.broadcast_to(where[:, None] if where.ndim == 1 else where, shape)
        given = np.where(everywhere, 0.0 if prescribed is None else prescribed, np.nan)
    for support in supports:
        if isinstance(support, DirichletBC):
            value = support.on(basis, scale, origin)
            given = np.where(np.isnan(value), given, value)
    return given, concatenate_foundations(
        [s.on(basis, scale, origin) for s in supports if isinstance(s, RobinBC)]
    )

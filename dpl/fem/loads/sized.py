"""Bases of load families whose size is given in SI units or follows from a linear deflection."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dpl.fem.loads.family import RandomLoads
from dpl.fem.loads.fit import amplitudes, project
from dpl.fem.loads.sampling import Array, direction
from dpl.fem.options import DIMENSIONLESS, declared, option, shown
from dpl.fem.solvers.linear import LinearSolver

MIN_DEFLECTION = 1e-12  # below it the displacement is rounding error [-]
DIGITS = 12  # digits of a size that identify a family; the last ones depend on units


@dataclass(frozen=True, eq=False)
class SizedLoads(RandomLoads):
    """Base of load families whose forces have a random size.

    A subclass defines `unit_deflection`, and declares an option in Pa or N: the largest size, or
    the range of sizes.

    Attributes:
        deflection: Largest linear deflection over L [-]: the sizes lie between 0 and the size at
            which the largest load deflects the body as far. Options in SI units replace it.
    """

    _: KW_ONLY
    deflection: float = option("times L", default=0.2, least=MIN_DEFLECTION, most=10.0)

    @property
    def given_sizes(self) -> Array | None:
        """Smallest and largest size in the options, (2,) [-]; None if `deflection` decides."""
        options, units = declared(self), self.problem.units
        name, unit = next((one.name, b.unit) for one, b in options if b.unit in ("Pa", "N"))
        if (value := getattr(self, name)) is None:
            return None
        ends = np.array(value if isinstance(value, Sequence) else [0.0, value], dtype=np.float64)
        words = f"{name} = {shown(value)}"
        if unit == "Pa":
            return units.stress(ends, words)
        return units.force(ends, self.problem.shape[1], words)

    @property
    @abstractmethod
    def unit_deflection(self) -> float:
        """Largest linear deflection over L of the loads of size 1 [-]."""

    @cached_property
    def sizes(self) -> tuple[float, float]:
        """Smallest and largest size [-]."""
        if (given := self.given_sizes) is not None:
            return float(given[0]), float(given[1])
        unit = self.unit_deflection
        if not 0 < unit < math.inf:
            raise ValueError("these loads act on fixed nodes only; they must act on a free node")
        return 0.0, self.deflection / unit

    @property
    def largest_size(self) -> float:
        """Largest magnitude of a size [-]."""
        return max(map(abs, self.sizes))

    def size_at(self, t: Array) -> Array:
        """Return the sizes of numbers in [0, 1), of the same shape [-]."""
        low, high = self.sizes
        return low + (high - low) * t

    def amplitudes(self, sizes: Array) -> Array:
        """Return the amplitudes of sizes [-], of the same shape, see `LoadFamily.project`."""
        return amplitudes(sizes, *self.sizes, self.largest_size)

    def vector_at(self, point: Array) -> Array:
        """Return the vector (D,) [-] of a point (D,) of the unit cube: its size and direction."""
        return self.size_at(point[0]) * direction(point[1:])

    def identity(self) -> dict[str, Any]:
        """Return the options with those in SI units as `sizes`, or with `deflection`."""
        given, options = self.given_sizes, super().identity()
        for one, bounds in declared(self):
            if bounds.unit not in DIMENSIONLESS:
                del options[one.name]
        if given is None:
            return options
        del options["deflection"]
        return options | {"sizes": rounded(given)}


@dataclass(frozen=True, eq=False)
class CombinedLoads(SizedLoads):
    """Base of load families of forces sum_k c_k f_k with few fixed forces f_k.

    The coefficients are independent, each a random size. A subclass defines `shapes`.
    """

    @property
    @abstractmethod
    def shapes(self) -> Tensor:
        """Fixed forces f_k, (K, N, D) [-]."""

    @property
    def n_force(self) -> int:
        """K, a number for each coefficient."""
        return len(self.shapes)

    def coefficients_at(self, point: Array) -> Array:
        """Return the coefficients (K,) of a point (n_force,) of the unit cube."""
        return self.size_at(point)

    @property
    def coefficient_range(self) -> tuple[float, float]:
        """Smallest and largest coefficient [-]."""
        return self.sizes

    @property
    def unit_deflection(self) -> float:
        """Largest linear deflection [-] of the sum of all f_k, if their signs add up at a node."""
        moved = [self.linear.reference.solve_force(shape).norm(dim=1) for shape in self.shapes]
        return float(torch.stack(moved).sum(dim=0).max())

    @property
    def unit_force(self) -> float:
        """Norm of all f_k [-], as if they acted on different nodes."""
        return float(self.problem.acting(self.shapes).norm())

    @property
    def largest_force(self) -> float:
        """Norm of the largest force [-]."""
        size = self.largest_size
        if not (norm := size * self.unit_force) > 0:
            raise ValueError("these loads act on fixed nodes only; they must act on a free node")
        return norm

    @cached_property
    def loadable_dofs(self) -> Tensor:
        """Free degrees of freedom on which a force acts, (N, D), boolean."""
        return (self.shapes != 0).any(dim=0) & self.problem.free

    def force_at(self, point: Array) -> Tensor:
        return torch.tensordot(torch.from_numpy(self.coefficients_at(point)), self.shapes, dims=1)

    def project(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return amplitudes and relative residuals of a least-squares fit, see `LoadFamily`."""
        # as of one node with N D components, so that entries without a force count, too
        shapes, own = self._acting_shapes[None], self.own_force(force).flatten(1)[:, None]
        return project(shapes, own, self.coefficient_range, self.amplitudes)

    @cached_property
    def _acting_shapes(self) -> Array:
        """The f_k on free degrees of freedom, (N D, K)."""
        return np.ascontiguousarray(self.problem.acting(self.shapes).flatten(1).numpy().T)


@dataclass(frozen=True, eq=False)
class VectorLoads(CombinedLoads):
    """Base of load families of a vector of random size and direction times fixed nodal weights.

    A subclass defines `weights`.
    """

    @property
    @abstractmethod
    def weights(self) -> Tensor:
        """Force of a unit vector at each node, (N,) [-]."""

    @cached_property
    def shapes(self) -> Tensor:
        """Forces of the unit vectors along the axes, (D, N, D) [-]."""
        axes = torch.eye(self.problem.shape[1], dtype=torch.float64)
        return torch.einsum("n,kd->knd", self.weights, axes)

    def coefficients_at(self, point: Array) -> Array:
        """Return the vector (D,) of a point (D,) of the unit cube."""
        return self.vector_at(point)

    @property
    def coefficient_range(self) -> tuple[float, float]:
        """Smallest and largest component of a vector [-]."""
        return -self.largest_size, self.largest_size

    def amplitudes(self, sizes: Array) -> Array:
        """Return the amplitude of a vector (D,) [-], (1,)."""
        return super().amplitudes(np.linalg.norm(sizes[None], axis=1))

    @property
    def unit_deflection(self) -> float:
        """Largest linear deflection [-] of the unit vectors of all directions."""
        return float(deflections(self.linear.reference, self.shapes).max())

    @property
    def unit_force(self) -> float:
        """Largest norm [-] of the forces of the unit vectors of all directions."""
        shapes = self.problem.acting(self.shapes).flatten(1)
        return float(torch.linalg.matrix_norm(shapes, 2))


def rounded(values: Array) -> list[float]:
    """Return numbers for an identity without the last digits, which depend on units."""
    return [float(f"{value:.{DIGITS}g}") for value in values]


def softest_node(linear: LinearSolver, nodes: Tensor) -> int:
    """Return a node that yields most to forces of any direction, among `nodes` (n,).

    The compliance C is positive definite, so that |C_ij|^2 <= |C_ii| |C_jj| for its blocks. If
    forces at a node move another node further than their own, the other one is therefore softer.
    The search begins at the node that forces on all nodes move most, and goes to softer nodes until
    there is none.
    """
    found: int | None = None
    while True:
        forces = point_forces(linear.problem.shape, nodes if found is None else [found])
        sizes = deflections(linear, forces)
        best = int(nodes[int(sizes[nodes].argmax())])
        if found is not None and not sizes[best] > sizes[found] * (1 + 1e-9):
            return found
        found = best


def point_forces(shape: Sequence[int], nodes: Tensor | list[int]) -> Tensor:
    """Return unit forces at each of some nodes (n,) along each axis, (D, N, D)."""
    forces = torch.zeros(shape[1], *shape, dtype=torch.float64)
    for axis in range(shape[1]):
        forces[axis, nodes, axis] = 1.0
    return forces


def deflections(linear: LinearSolver, axes: Tensor) -> Tensor:
    """Return the largest deflection of each node by c_k f_k (K, N, D) with |c| = 1, (N,) [-]."""
    moved = torch.stack([linear.solve_force(force) for force in axes], dim=-1)  # (N, D, K)
    return torch.linalg.matrix_norm(moved, 2)

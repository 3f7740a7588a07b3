"""Bases of load families whose forces are combinations of few fixed forces."""

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from dpl.fem.loads.fit import fit
from dpl.fem.loads.sampling import Array
from dpl.fem.loads.sized import SizedLoads, largest_deflection


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
        """Number of random numbers: K, one for each coefficient."""
        return len(self.shapes)

    def coefficients_at(self, point: Array) -> Array:
        """Return the coefficients (K,) of a point (n_force,) of the unit cube."""
        return self.size_at(point)

    @property
    def coefficient_range(self) -> tuple[float, float]:
        """Smallest and largest coefficient [-]."""
        return self.sizes

    def sizes_of(self, coefficients: Array) -> Array:
        """Return the sizes of coefficients (K,), which have the range `sizes`."""
        return coefficients

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
        """Norm of the largest force [-].

        Raises:
            ValueError: The loads have a range of moduli, or no force acts on a free node.
        """
        size = self.largest_size
        if not (norm := size * self.unit_force) > 0:
            raise ValueError("these loads act on fixed nodes only; they must act on a free node")
        return norm

    @cached_property
    def loadable_dofs(self) -> Tensor:
        """Free degrees of freedom on which a force acts, (N, D), boolean."""
        return (self.shapes != 0).any(dim=0) & self.problem.free

    def force_at(self, point: Array) -> Tensor:
        """Return the force (N, D) [-] of a point (n_force,) of the unit cube."""
        return torch.tensordot(torch.from_numpy(self.coefficients_at(point)), self.shapes, dims=1)

    def project(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return amplitudes and relative residuals of a least-squares fit, see `LoadFamily`."""
        # as of one node with N D components, so that entries without a force count, too
        shapes, span = self._acting_shapes[None], self.coefficient_range
        forces = self.own_force(force).flatten(1)[:, None].numpy()
        fits = [fit(shapes, own, *span) for own in forces]
        largest = [self.amplitudes(self.sizes_of(c)).max() for c, _ in fits]
        return force.new_tensor(largest), force.new_tensor([rest for _, rest in fits])

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

    def sizes_of(self, coefficients: Array) -> Array:
        """Return the norm of a vector (D,), (1,)."""
        return np.linalg.norm(coefficients[None], axis=1)

    @property
    def unit_deflection(self) -> float:
        """Largest linear deflection [-] of the unit vectors of all directions."""
        return largest_deflection(self.linear.reference, self.shapes)

    @property
    def unit_force(self) -> float:
        """Largest norm [-] of the forces of the unit vectors of all directions."""
        shapes = self.problem.acting(self.shapes).flatten(1)
        return float(torch.linalg.matrix_norm(shapes, 2))

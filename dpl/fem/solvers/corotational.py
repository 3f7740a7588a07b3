"""Corotational preconditioner: the factor of K(0), rotated node by node.

Under large rotations and small strains the tangent is close to K(0) in the rotated frames of the
nodes (stiffness warping).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import float64, int64, njit, void
from numba.types import Array as Typed
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.assembly.discretisation import Discretisation
from dpl.fem.assembly.simd import SIMD_WIDTH, load, store
from dpl.fem.linear.interface import Array, Factor

MAX_POLAR_ITER = 20  # of a polar decomposition; near a rotation it takes three iterations
POLAR_TOL = 1e-5  # change of an iteration below which the error is below rounding (its square)
IDENTITY = np.eye(3).ravel()

VALUES = Typed(float64, 1, "C", readonly=True)
TABLE = Typed(float64, 2, "C", readonly=True)
TENSORS = Typed(float64, 3, "A", readonly=True)
INDICES = Typed(int64, 2, "C", readonly=True)


@dataclass(frozen=True, eq=False)
class CorotationalPreconditioner:
    """Preconditioner R K(0)^-1 R^T with the rotations R of the nodes.

    Source: Mueller, Dorsey, McMillan, Jagnow, Cutler (2002), Stable real-time deformations,
    section 3.2.
    """

    discretisation: Discretisation  # cells and free degrees of freedom of the body
    factor: Factor  # factor of its K(0)

    def at(self, displacement: Tensor) -> "CorotatedFactor":
        """Return the factor of K(0), rotated as the body is at a displacement (1, N, D) [-].

        A node has the rotation of its mean deformation gradient. A node fixed in one direction is
        rotated about that direction only, a node fixed in two is not rotated. In 2D the rotations
        are those about the third axis.
        """
        gradients, volumes, cells, weights, numbers = self._arrays
        u = np.zeros((len(numbers), 3))
        u[:, : displacement.shape[2]] = displacement[0].numpy()
        sums = np.zeros((len(u), 9))
        _sum_gradients(u, cells, gradients, volumes, sums)
        rotations = np.empty((len(u), 3, 3))
        _rotations(sums, weights, rotations.reshape(-1, 9))
        return CorotatedFactor(self.factor, rotations, numbers)

    @cached_property
    def _arrays(self) -> tuple[Array, Array, NDArray[np.int64], Array, NDArray[np.int64]]:
        """Arrays of the loops over cells and nodes, in 2D with zeros in the third direction.

        They are the mean gradients of the shape functions (E or 1, A, 3), volumes (E or 1,) and
        nodes (E, A) of the cells; for each node one over the volume of its cells where row and
        column of its gradient are free, else 0, (N, 9), and the numbers of its free degrees of
        freedom, else -1, (N, 3).
        """
        dN, dV = self.discretisation.dN.numpy(), self.discretisation.dV.numpy()
        # a copy: sending the problem to a process moves the memory of its tensors
        cells = self.discretisation.cells.numpy().copy(order="C")
        (nodes, dim), volumes = self.discretisation.shape, dV.sum(axis=1)
        gradients = np.zeros((len(dN), dN.shape[2], 3))
        gradients[..., :dim] = np.einsum("eqaj,eq->eaj", dN, dV) / volumes[:, None, None]
        numbers, free_numbers = np.full((nodes, 3), -1), self.discretisation.free_numbers
        numbers[np.divmod(free_numbers, dim)] = np.arange(len(free_numbers))
        free, each = numbers >= 0, np.broadcast_to(volumes[:, None], cells.shape)
        around = np.bincount(cells.ravel(), each.ravel(), nodes)
        turned = free & (free.sum(axis=1, keepdims=True) > 1)
        weights = (turned[:, :, None] & turned[:, None, :]) / around[:, None, None]
        return gradients, volumes, cells, weights.reshape(nodes, 9), numbers


@dataclass(frozen=True, eq=False)
class CorotatedFactor(Factor):
    """R K(0)^-1 R^T, symmetric, and positive definite if K(0) is."""

    factor: Factor  # factor of K(0)
    rotations: Array  # rotations R of the nodes, (N, 3, 3)
    numbers: NDArray[np.int64]  # numbers of the free degrees of freedom, else -1, (N, 3)

    def local(self, values: Array) -> Array:
        """Return R^T times values at free degrees of freedom, (n,)."""
        return _rotated(self.rotations.mT, self.numbers, values)

    def turned(self, values: Array) -> Array:
        """Return R times values at free degrees of freedom, (n,)."""
        return _rotated(self.rotations, self.numbers, values)

    def apply(self, right: Array) -> Array:
        """Return R M R^T right, (n,), M the inverse of K(0) or its preconditioner."""
        return self.turned(self.factor.apply(self.local(right)))

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return R K(0)^-1 R^T right, (n,), to a relative residual, see `Factor.solve`."""
        return self.turned(self.factor.solve(self.local(right), rtol))


# One explicit signature each: numba's cache can mix up the machine code of several signatures of a
# function when two processes save them at the same time.
@njit([void(TABLE, INDICES, TENSORS, VALUES, float64[:, ::1])], cache=True)
def _sum_gradients(u, cells, gradients, volumes, out):
    """Add volume times mean gradient of u (N, 3) in the cells of each node to `out` (N, 9)."""
    mean = np.empty(9)
    for e in range(len(cells)):
        own = e if len(gradients) > 1 else 0
        for i in range(3):
            p, q, r = 0.0, 0.0, 0.0
            for a in range(cells.shape[1]):
                value = u[cells[e, a], i]
                p += value * gradients[own, a, 0]
                q += value * gradients[own, a, 1]
                r += value * gradients[own, a, 2]
            for k, part in enumerate((p, q, r)):  # numba compiles a slice for two seconds
                mean[3 * i + k] = volumes[own] * part
        for a in range(cells.shape[1]):
            node = cells[e, a]
            for k in range(9):
                out[node, k] += mean[k]


@njit
def set_cofactors(X, out):
    """Set `out` (9, width) to the cofactors of X (9, width); return det X."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            minor = load(X, 3 * j + d) * load(X, 3 * k + e) - load(X, 3 * j + e) * load(
                X, 3 * k + d
            )
            store(out, 3 * i + c, minor)
    return load(X, 0) * load(out, 0) + load(X, 1) * load(out, 1) + load(X, 2) * load(out, 2)


@njit
def polar_step(X, minors):
    """Make an iteration X <- (X + X^-T) / 2 towards the rotation of X (9, width), det X > 0.

    Return the sum of the squares of its change; `minors` (9, width) is overwritten.

    Source: Higham (1986), SIAM J. Sci. Stat. Comput. 7.
    """
    half = 0.5 / set_cofactors(X, minors)
    squares = 0.0 * half
    for r in range(9):
        change = half * load(minors, r) - 0.5 * load(X, r)
        squares = squares + change * change
        store(X, r, load(X, r) + change)
    return squares


@njit([void(TABLE, TABLE, float64[:, ::1])], cache=True)
def _rotations(sums, weights, out):
    """Set `out` (N, 9) to the rotations of the gradients I + weights * sums, (N, 9) each.

    The rotation of a gradient with det <= 0 is the identity.
    """
    X, minors = np.empty((9, SIMD_WIDTH)), np.empty((9, SIMD_WIDTH))
    det, squares = np.empty((1, SIMD_WIDTH)), np.empty((1, SIMD_WIDTH))
    for start in range(0, len(sums), SIMD_WIDTH):
        count = min(SIMD_WIDTH, len(sums) - start)
        for lane in range(SIMD_WIDTH):
            node = start + min(lane, count - 1)
            for r in range(9):
                X[r, lane] = IDENTITY[r] + weights[node, r] * sums[node, r]
        store(det, 0, set_cofactors(X, minors))
        for _ in range(MAX_POLAR_ITER):
            store(squares, 0, polar_step(X, minors))
            largest = 0.0
            for lane in range(count):
                if det[0, lane] > 0:
                    largest = max(largest, squares[0, lane])
            if largest < POLAR_TOL**2:
                break
        for lane in range(count):
            node = start + lane
            for r in range(9):
                is_free = det[0, lane] > 0 and weights[node, r] > 0
                out[node, r] = X[r, lane] if is_free else IDENTITY[r]


@njit([float64[::1](TENSORS, INDICES, VALUES)], cache=True)
def _rotated(R, numbers, x):
    """Return the products of R (N, 3, 3) with the vectors of the nodes, (n,), zero where fixed."""
    out = np.empty_like(x)
    for n in range(len(numbers)):
        i, j, k = numbers[n, 0], numbers[n, 1], numbers[n, 2]
        a, b, c = x[i] if i >= 0 else 0.0, x[j] if j >= 0 else 0.0, x[k] if k >= 0 else 0.0
        if i >= 0:
            out[i] = R[n, 0, 0] * a + R[n, 0, 1] * b + R[n, 0, 2] * c
        if j >= 0:
            out[j] = R[n, 1, 0] * a + R[n, 1, 1] * b + R[n, 1, 2] * c
        if k >= 0:
            out[k] = R[n, 2, 0] * a + R[n, 2, 1] * b + R[n, 2, 2] * c
    return out

"""Corotational preconditioner: the factor of K(0), rotated node by node.

Under large rotations and small strains the tangent is close to K(0) in the rotated frames of the
nodes (stiffness warping).
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import float64, int64, njit, void
from numba.types import Array as Typed
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from torch import Tensor

from dpl.fem.linear.interface import Array, Factor, SingularMatrix, SymmetricProduct
from dpl.fem.linear.krylov import conjugate_gradients, smallest_ritz_value
from dpl.fem.problem import Problem

MAX_POLAR_ITER = 20  # of a polar decomposition; near a rotation it takes three iterations
POLAR_TOL = 1e-5  # change of an iteration below which the error is below rounding (its square)

FIELD = Typed(float64, 2, "A", readonly=True)  # (N, D)
TENSORS = Typed(float64, 3, "A", readonly=True)  # (N, D, D)
VALUES = Typed(float64, 1, "A", readonly=True)
INDICES = Typed(int64, 2, "A", readonly=True)
OUT = Typed(float64, 3, "A")


@dataclass(frozen=True, eq=False)
class CorotationalPreconditioner:
    """Preconditioner R K(0)^-1 R^T with the rotations R of the nodes.

    Source: Mueller, Dorsey, McMillan, Jagnow, Cutler (2002), Stable real-time deformations,
    section 3.2.

    Attributes:
        problem: The body.
        factor: Factor of its K(0).
    """

    problem: Problem
    factor: Factor

    def at(self, displacement: Tensor) -> "CorotatedFactor":
        """Return the factor of K(0), rotated as the body is at a displacement (1, N, D) [-].

        A node has the rotation of its mean deformation gradient. A node fixed in one direction is
        rotated about that direction only, a node fixed in two is not rotated.
        """
        gradients, volumes, cells = self._cell_means
        rotations = np.zeros((*self.problem.shape, self.problem.shape[1]))
        _sum_gradients(displacement[0].numpy(), cells, gradients, volumes, rotations)
        _to_rotations(rotations, self.problem.pattern.number)
        kept, indices, indptr = self._structure
        R = csr_array((rotations[kept], indices, indptr), shape=(self.problem.pattern.size,) * 2)
        return CorotatedFactor(self.factor, rotations, R)

    def count_iterations(
        self, displacement: Tensor, *, rtol: float = 1e-3, max_iter: int = 50
    ) -> int:
        """Return the conjugate gradient iterations with the tangent at (1, N, D) and this factor.

        The right-hand side is random; the result is at most `max_iter`.
        """
        product = self._tangent(displacement)
        right = np.random.default_rng(0).standard_normal(self.problem.pattern.size)
        factor, calls = self.at(displacement), []

        def apply(residual: Array) -> Array:
            calls.append(residual)
            return factor.apply(residual)

        with suppress(SingularMatrix):
            conjugate_gradients(product, apply, right, rtol, max_iter)
            return len(calls)
        return max_iter

    def smallest_ritz_value(self, displacement: Tensor) -> float:
        """Return the smallest Ritz value of this inverse times the tangent at (1, N, D) [-]."""
        product, factor = self._tangent(displacement), self.at(displacement)
        return smallest_ritz_value(product, factor.apply, self.problem.pattern.size)

    def _tangent(self, displacement: Tensor) -> SymmetricProduct:
        values = self.problem.linearise(displacement).tangent[0].numpy()
        return SymmetricProduct(self.problem.pattern, values)

    @cached_property
    def _cell_means(self) -> tuple[Array, Array, NDArray[np.int64]]:
        """Mean gradients of the shape functions (E or 1, A, D), volumes (E or 1,), cells."""
        dN, dV = self.problem.dN.numpy(), self.problem.dV.numpy()
        volumes = dV.sum(axis=1)
        gradients = np.einsum("eqaj,eq->eaj", dN, dV) / volumes[:, None, None]
        # a copy: sending the problem to a process moves the memory of its tensors
        return gradients, volumes, self.problem.cells.numpy().copy(order="C")

    @cached_property
    def _structure(self) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
        """Mask of the entries of R at free degrees of freedom, their columns and rows in CSR."""
        free, number = self.problem.free.numpy(), self.problem.pattern.number
        kept = free[:, :, None] & free[:, None, :]
        columns = np.broadcast_to(number[:, None, :], kept.shape)[kept]
        return kept, columns, np.concatenate([[0], kept.sum(axis=2)[free].cumsum()])


@dataclass(frozen=True, eq=False)
class CorotatedFactor:
    """R K(0)^-1 R^T, symmetric, and positive definite if K(0) is.

    Attributes:
        factor: Factor of K(0).
        rotations: Rotations R of the nodes, (N, D, D).
        matrix: R at free degrees of freedom, (n, n).
    """

    factor: Factor
    rotations: Array
    matrix: csr_array

    @property
    def negative_pivots(self) -> int | None:
        """Negative pivots of K(0)."""
        return self.factor.negative_pivots

    def apply(self, right: Array) -> Array:
        """Return R M R^T right, (n,), M the inverse of K(0) or its preconditioner."""
        return self.matrix @ self.factor.apply(self._transposed @ right)

    def solve(self, right: Array, rtol: float) -> Array:
        """Return R K(0)^-1 R^T right, (n,), to a relative residual, see `Factor.solve`."""
        return self.matrix @ self.factor.solve(self._transposed @ right, rtol)

    @cached_property
    def _transposed(self) -> csc_array:
        """R^T at free degrees of freedom, (n, n)."""
        return self.matrix.T


# One explicit signature each: numba's cache can mix up the machine code of several signatures of a
# function when two processes save them at the same time.
@njit([void(FIELD, INDICES, TENSORS, VALUES, OUT)], cache=True)
def _sum_gradients(u, cells, gradients, volumes, F):
    """Set F (N, D, D) to the sum of volume times mean gradient over the cells of each node."""
    dim = u.shape[1]
    mean = np.empty((dim, dim))
    for e in range(cells.shape[0]):
        own = e if gradients.shape[0] > 1 else 0
        for i in range(dim):
            for j in range(dim):
                mean[i, j] = 1.0 if i == j else 0.0
                for a in range(cells.shape[1]):
                    mean[i, j] += u[cells[e, a], i] * gradients[own, a, j]
        for a in range(cells.shape[1]):
            for i in range(dim):
                for j in range(dim):
                    F[cells[e, a], i, j] += volumes[own] * mean[i, j]


@njit
def _plane(X, a, b, R):
    """Set rows and columns a and b of R to the rotation of that block of X if its det > 0."""
    cosine, sine = X[a, a] + X[b, b], X[b, a] - X[a, b]
    size = np.sqrt(cosine**2 + sine**2)
    if X[a, a] * X[b, b] - X[a, b] * X[b, a] > 0 and size > 0:
        R[a, a], R[b, b] = cosine / size, cosine / size
        R[b, a], R[a, b] = sine / size, -sine / size


@njit
def _cofactors(X, out):
    """Set `out` to the cofactors of X (3, 3); return its determinant."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            out[i, c] = X[j, d] * X[k, e] - X[j, e] * X[k, d]
    return X[0, 0] * out[0, 0] + X[0, 1] * out[0, 1] + X[0, 2] * out[0, 2]


@njit
def _polar(X, R):
    """Set R to the rotation of X (3, 3) if det X > 0; overwrite X.

    Source: Higham (1986), SIAM J. Sci. Stat. Comput. 7: X <- (s X + X^-T / s) / 2.
    """
    inverse = np.empty((3, 3))  # transposed
    change = 1.0
    for _ in range(MAX_POLAR_ITER):
        if change < POLAR_TOL:
            break
        det = _cofactors(X, inverse)
        if not det > 0:
            return
        size, other = 0.0, 0.0
        for i in range(3):
            for j in range(3):
                inverse[i, j] /= det
                size += X[i, j] ** 2
                other += inverse[i, j] ** 2
        scale = np.sqrt(np.sqrt(other / size))
        change = 0.0
        for i in range(3):
            for j in range(3):
                new = 0.5 * (scale * X[i, j] + inverse[i, j] / scale)
                change = max(change, abs(new - X[i, j]))
                X[i, j] = new
    R[:] = X


@njit([void(OUT, INDICES)], cache=True)
def _to_rotations(F, dofs):
    """Replace each gradient (N, D, D), known up to a positive factor, by its rotation.

    A node with two free components gets the rotation in their plane, one with fewer the identity.
    """
    dim = F.shape[1]
    R = np.empty((dim, dim))
    for n in range(F.shape[0]):
        count, last = 0, -1
        for i in range(dim):
            if dofs[n, i] >= 0:
                count += 1
            else:
                last = i
        for i in range(dim):
            for j in range(dim):
                R[i, j] = 1.0 if i == j else 0.0
        if count == 2:
            a = 0 if last != 0 else 1
            b = 3 - a - last if dim == 3 else 1
            _plane(F[n], a, b, R)
        elif count == 3:
            _polar(F[n], R)
        F[n] = R

"""The factor of K(0), turned with the nodes of a body: a preconditioner for tangents far from rest.

Where rotations are large and strains are not, the tangent is K(0) with its nodes turned, nearly.
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import boolean, float64, int64, njit, void
from numba.types import Array as Typed
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.linear.interface import Array, Factor, SingularMatrix, SymmetricProduct
from dpl.fem.linear.krylov import conjugate_gradients
from dpl.fem.problem import Problem

POLAR = 20  # iterations of a polar decomposition at most; near a rotation it takes three
ENOUGH = 1e-5  # change by the last one after which the error is of its square

FIELD = Typed(float64, 2, "A", readonly=True)  # (N, D)
TENSORS = Typed(float64, 3, "A", readonly=True)  # (N, D, D)
VALUES = Typed(float64, 1, "A", readonly=True)
PLACES = Typed(int64, 2, "A", readonly=True)
OUT = Typed(float64, 3, "A")


@dataclass(frozen=True, eq=False)
class CorotationalPreconditioner:
    """How the nodes of a body have turned.

    Attributes:
        problem: The body.
        factor: Of its K(0).
    """

    problem: Problem
    factor: Factor

    def at(self, displacement: Tensor) -> "CorotatedFactor":
        """Return the factor of K(0), turned as the body is at a displacement (1, N, D) [-].

        A node turns by the rotation of its mean deformation gradient, one that is held in one
        direction only across that, one that is held in two not at all.

        Source: Mueller, Dorsey, McMillan, Jagnow, Cutler (2002), Stable real-time deformations,
        section 3.2 (K(0), turned node by node).
        """
        slopes, volumes, cells = self._means
        rotations = np.zeros((*self.problem.shape, self.problem.shape[1]))
        _gradients(displacement[0].numpy(), cells, slopes, volumes, rotations)
        _rotations(rotations, self._places)
        return CorotatedFactor(self.factor, rotations, self._places)

    def steps(self, displacement: Tensor, *, rtol: float = 1e-3, most: int = 50) -> int:
        """Return the conjugate gradient steps that the tangent at a displacement (1, N, D) takes.

        From noise, with the turned factor of K(0); `most` where it takes more.
        """
        tangent = self.problem.linearise(displacement).tangent[0].numpy()
        product = SymmetricProduct(self.problem.pattern, tangent)
        noise = np.random.default_rng(0).standard_normal(self.problem.pattern.size)
        turned, count = self.at(displacement), 0

        def counted(residual: Array) -> Array:
            nonlocal count
            count += 1
            return turned.apply(residual)

        with suppress(SingularMatrix):
            conjugate_gradients(product, counted, noise, rtol, most)
            return count
        return most

    @cached_property
    def _means(self) -> tuple[Array, Array, NDArray[np.int64]]:
        """Mean gradients of the shape functions (E or 1, A, D), volumes (E or 1,), cells."""
        dN, dV = self.problem.dN.numpy(), self.problem.dV.numpy()
        volumes = dV.sum(axis=1)
        slopes = np.einsum("eqaj,eq->eaj", dN, dV) / volumes[:, None, None]
        # a copy: sending the problem to a process moves the memory of its tensors
        return slopes, volumes, self.problem.cells.numpy().copy(order="C")

    @cached_property
    def _places(self) -> NDArray[np.int64]:
        """Where each degree of freedom is among the free ones, -1 where it is held, (N, D)."""
        free = self.problem.free.numpy()
        places = np.full(free.shape, -1, dtype=np.int64)
        places[free] = np.arange(free.sum())
        return places


@dataclass(frozen=True, eq=False)
class CorotatedFactor:
    """K(0)^-1 in a body's turned frame: symmetric and, as K(0) is, positive definite.

    Attributes:
        factor: Of K(0).
        rotations: Of the nodes, (N, D, D).
        places: Where each degree of freedom is among the free ones, -1 where it is held, (N, D).
        negative_pivots: Those of K(0).
    """

    factor: Factor
    rotations: Array
    places: NDArray[np.int64]

    @property
    def negative_pivots(self) -> int | None:
        """Those of K(0)."""
        return self.factor.negative_pivots

    def apply(self, right: Array) -> Array:
        """Return R K(0)^-1 R^T right, (n,)."""
        inner = np.empty_like(right)
        _turn(self.rotations, self.places, right, True, inner)
        answer = self.factor.apply(inner)
        _turn(self.rotations, self.places, answer, False, inner)
        return inner


# One signature each, compiled at once: two processes that save several of one function's to numba's
# cache at the same time could take each other's machine code for their own.
@njit([void(FIELD, PLACES, TENSORS, VALUES, OUT)], cache=True)
def _gradients(u, cells, slopes, volumes, F):
    """Set F (N, D, D) to the sums, over the cells of a node, of volume times mean gradient."""
    dim = u.shape[1]
    mean = np.empty((dim, dim))
    for e in range(cells.shape[0]):
        own = e if slopes.shape[0] > 1 else 0
        for i in range(dim):
            for j in range(dim):
                mean[i, j] = 1.0 if i == j else 0.0
                for a in range(cells.shape[1]):
                    mean[i, j] += u[cells[e, a], i] * slopes[own, a, j]
        for a in range(cells.shape[1]):
            for i in range(dim):
                for j in range(dim):
                    F[cells[e, a], i, j] += volumes[own] * mean[i, j]


@njit
def _plane(X, a, b, R):
    """Set rows and columns a and b of R to the rotation of those of X, unless they invert."""
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
    """Set R to the rotation of X (3, 3), which is overwritten; leave it unless det X > 0.

    Source: Higham (1986), SIAM J. Sci. Stat. Comput. 7: X <- (s X + X^-T / s) / 2.
    """
    inverse = np.empty((3, 3))  # transposed
    change = 1.0
    for _ in range(POLAR):
        if change < ENOUGH:
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


@njit([void(OUT, PLACES)], cache=True)
def _rotations(F, places):
    """Set each gradient (N, D, D), up to a positive factor, to its node's rotation.

    Of a node with two free components, only the rotation in their plane; of one with fewer, none.
    """
    dim = F.shape[1]
    R = np.empty((dim, dim))
    for n in range(F.shape[0]):
        count, last = 0, -1
        for i in range(dim):
            if places[n, i] >= 0:
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


@njit([void(TENSORS, PLACES, VALUES, boolean, Typed(float64, 1, "A"))], cache=True)
def _turn(rotations, places, values, back, out):
    """Set out (n,) to the free values (n,), turned node by node; by the transposed with `back`."""
    dim = places.shape[1]
    for n in range(places.shape[0]):
        for i in range(dim):
            if places[n, i] < 0:
                continue
            total = 0.0
            for j in range(dim):
                if places[n, j] >= 0:
                    turn = rotations[n, j, i] if back else rotations[n, i, j]
                    total += turn * values[places[n, j]]
            out[places[n, i]] = total

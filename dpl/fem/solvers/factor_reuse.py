"""Which factor serves which tangent on the way to an answer: its own, the last one's, K(0)'s."""

from collections.abc import Callable
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.linear.interface import Factor, SingularMatrix, SymmetricProduct
from dpl.fem.linear.krylov import CGFactor, conjugate_gradients, smallest_ritz_value
from dpl.fem.problem import Problem
from dpl.fem.solvers.corotational import CorotatedFactor
from dpl.fem.solvers.linear import LinearSolver

Factorise = Callable[[NDArray[np.float64]], Factor]

DOUBT = 0.05  # eigenvalue, relative to a factor nearby, below which a tangent is examined
PATIENCE = 8  # conjugate gradient steps with the factor of another tangent, then its own
TURNS = 16  # of the same with K(0)'s, turned


class FactorCache:
    """The factors that one load needs on its way.

    The one at hand preconditions conjugate gradients on the next tangents until they take too many
    steps or it is forgotten; then a tangent is factorised. Only positive definite ones are kept.

    Attributes:
        count: Tangents factorised so far; K(0) is not counted.
    """

    def __init__(self, rest: LinearSolver, factorise: Factorise, *, corotational: bool) -> None:
        """Begin with none.

        Args:
            rest: Brings the body and the factor of K(0).
            factorise: From the entries of a tangent, (nnz,), to its factor.
            turned: Let the factor of K(0), turned with the nodes, be at hand where no other is.
        """
        self.rest, self.factorise, self.corotational = rest, factorise, corotational
        self.count = 0
        self._pivots = -1  # negative ones of the last tangent that was factorised
        self._near: Factor | CorotatedFactor | None = None  # the one at hand
        self._served: SymmetricProduct | None = None  # the last tangent, if an older factor did

    def invalidate(self) -> None:
        """Let the one at hand go: the next tangent is too far from its own."""
        self._near = None

    def at_rest(self, right: NDArray[np.float64], rtol: float) -> NDArray[np.float64]:
        """Return K(0)^-1 of a right-hand side (n,), to a relative residual.

        Raises:
            SingularMatrix: K(0) has no factor.
        """
        self._served, factor = None, self.rest.factor
        self._pivots = count_negative_pivots(factor)
        return factor.solve(right, rtol)

    def solve(
        self, tangent: NDArray[np.float64], u: Tensor, right: NDArray[np.float64], rtol: float
    ) -> NDArray[np.float64]:
        """Return K^-1 of a right-hand side (n,), to a relative residual.

        Args:
            tangent: Entries of K, (nnz,).
            u: Where it is the tangent, (1, N, D) [-].
            right: What the step has to balance.
            rtol: Relative residual that may be left.

        Raises:
            SingularMatrix: It has no factor.
        """
        self._served = None
        if self._near is None and self.corotational:
            self._near = self.rest.corotational.at(u)
        if self._near is not None and self._near.negative_pivots <= 0:
            product = SymmetricProduct(self.rest.problem.pattern, tangent)
            abort_if_slow = isinstance(self._near, CorotatedFactor)
            steps = TURNS if abort_if_slow else PATIENCE
            with suppress(SingularMatrix):
                step = conjugate_gradients(
                    product, self._near.apply, right, rtol, steps, abort_if_slow=abort_if_slow
                )
                self._served = product
                return step
        self.corotational &= not isinstance(self._near, CorotatedFactor)
        self.count += 1
        self._near = None  # its storage serves the next one
        self._near = self.factorise(tangent)
        step = self._near.solve(right, rtol)
        self._pivots = self._near.negative_pivots
        return step

    def negative_pivots(self, answer: Tensor) -> int:
        """Return those of the tangent at an answer (1, N, D); -1: not known.

        It is factorised only where it may have some: if the last tangent had some, or was not
        examined (conjugate gradients); or, where an older factor served for it, if it has an
        eigenvalue far below that factor's.
        """
        if isinstance(self._near, CorotatedFactor):
            return -1
        problem = self.rest.problem
        suspect = self._pivots > 0 or isinstance(self._near, CGFactor)
        if not suspect and self._served is not None and self._near is not None:
            with suppress(SingularMatrix):
                suspect |= (
                    smallest_ritz_value(self._served, self._near.apply, problem.pattern.size)
                    < DOUBT
                )
            self._served = None
        if suspect:
            self.count += 1
            self._near = None
            self._pivots = negative_pivots_at(problem, self.factorise, answer)
        return self._pivots


def count_negative_pivots(factor: Factor) -> int:
    """Return the negative eigenvalues of what was factorised, see `negative_pivots_at`."""
    return factor.definiteness if isinstance(factor, CGFactor) else factor.negative_pivots


def negative_pivots_at(problem: Problem, factorise: Factorise, displacement: Tensor) -> int:
    """Return the negative eigenvalues of the tangent at (1, N, D); 1 where it is singular.

    Conjugate gradients do not count them: 1 stands for some, -1 for not known.
    """
    tangent = problem.linearise(displacement).tangent
    try:
        return count_negative_pivots(factorise(tangent[0].numpy()))
    except SingularMatrix:  # at the critical load itself
        return 1

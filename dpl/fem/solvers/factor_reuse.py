"""Selection and reuse of the factors that precondition the tangents of one load."""

from contextlib import suppress

from torch import Tensor

from dpl.fem.linear.interface import (
    UNKNOWN,
    Array,
    Backend,
    Factor,
    SingularMatrix,
    SymmetricProduct,
)
from dpl.fem.linear.krylov import conjugate_gradients, smallest_ritz_value, solve_unsymmetric
from dpl.fem.problem import Problem
from dpl.fem.solvers.linear import LinearSolver

MIN_RITZ_VALUE = 0.05  # smallest eigenvalue of M^-1 K below which the tangent K is factorised
MAX_CG_STALE = 8  # conjugate gradient steps with a stale factor before the tangent is factorised
MAX_CG_COROTATED = 16  # the same with the corotated factor of K(0)


class TangentSolver:
    """Solver of K(u) x = r for the successive tangents of one load.

    A factor preconditions conjugate gradients on later tangents until these need too many steps.
    It is the factor of an earlier tangent near u, or else that of K(0), rotated node by node.

    Attributes:
        factorisations: Tangents factorised so far, without K(0).
    """

    def __init__(self, linear_solver: LinearSolver, *, corotational: bool) -> None:
        """Start without a factor; `corotational` allows the corotated factor of K(0)."""
        self.linear_solver, self.backend = linear_solver, linear_solver.tangent_backend
        self.factorisations, self._pattern = 0, linear_solver.problem.pattern
        self._corotational = corotational
        self._factor: Factor | None = None  # of the last solve
        self._rest: Factor | None = None  # that of K(0), once used
        self._corotated: Factor | None = None  # the same rotated, once used
        self._tangent: SymmetricProduct | None = None  # last one, if it was not factorised

    def solve(
        self,
        tangent: Array | None,
        u: Tensor,
        right: Array,
        rtol: float,
        *,
        near: bool,
        definite: bool = False,
        skew: Array | None = None,
    ) -> Array:
        """Return K(u)^-1 of a right-hand side (n,), u (1, N, D), to a relative residual `rtol`.

        The tangent has the entries of K(u), (nnz,), or is None for K(0); with the entries `skew` of
        (K - K^T) / 2 it is the symmetric part. `near` states that u is near enough to the last
        iterate to reuse its factor. A tangent without a factor raises a `SingularMatrix`, and with
        `definite` an indefinite one does too.
        """
        if tangent is None:
            self._rest = self._factor = self.linear_solver.factor
            self._tangent = None
            return self._factor.solve(right, rtol)
        factor = self._preconditioner(u, near=near)
        if factor is not None:
            self._factor, self._tangent = factor, SymmetricProduct(self._pattern, tangent)
            corotated, apply = factor is self._corotated, factor.apply
            steps = MAX_CG_COROTATED if corotated else MAX_CG_STALE
            with suppress(SingularMatrix):
                if skew is not None:
                    values = tangent, skew
                    return solve_unsymmetric(self._pattern, *values, apply, right, rtol, steps)
                return conjugate_gradients(
                    self._tangent, apply, right, rtol, steps, abort_if_slow=corotated
                )
            self._corotational &= not corotated
            del apply, factor  # free their storage before the next factorisation
        self._factor, self._tangent = None, None
        self.factorisations += 1
        factorise = self.backend.factorise
        if definite:
            factorise = getattr(self.backend, "definite", factorise)
        found = factorise(tangent)
        if found is None or (definite and found.negative_pivots):
            raise SingularMatrix("the tangent is indefinite")
        self._factor = found
        if skew is not None:
            return solve_unsymmetric(self._pattern, tangent, skew, found.apply, right, rtol)
        return found.solve(right, rtol)

    def _preconditioner(self, u: Tensor, *, near: bool) -> Factor | None:
        """Return the factor for conjugate gradients on K(u); None: K(u) is factorised."""
        last = self._factor if near and self._factor is not self._rest else None
        if last is not None and last is not self._corotated:
            return None if last.negative_pivots else last
        if not self._corotational or self.linear_solver.factor.negative_pivots:
            return None
        if last is None:
            self._corotated = self.linear_solver.corotational.at(u)
        return self._corotated

    def stability(self, u: Tensor) -> int:
        """Return the stability of the equilibrium (1, N, D) of the last solve, see `stability_at`.

        The tangent there is factorised only if the last factor has negative pivots or its backend
        does not count them, or if a Ritz value shows an eigenvalue far below the stale factor's.
        """
        factor, known = self._factor, 0
        if factor is None or factor is self._corotated:
            return UNKNOWN
        if factor is self._rest:
            known = factor.stability
            suspect = known > 0
        else:
            suspect = factor.negative_pivots != 0
        if not suspect and self._tangent is not None:  # which a stale factor has solved
            with suppress(SingularMatrix):
                least = smallest_ritz_value(self._tangent, factor.apply, self._pattern.size)
                suspect = least < MIN_RITZ_VALUE
        if not suspect:
            return known
        self.factorisations += 1
        self._factor = None
        return stability_at(self.linear_solver.problem, self.backend, u)


def stability_at(problem: Problem, backend: Backend, displacement: Tensor) -> int:
    """Return the number of negative eigenvalues of K(u), u (1, N, D), see `Factor.stability`.

    A singular tangent counts as unstable. Under a follower load without potential a positive
    definite symmetric part is sufficient for stability. It is not necessary: otherwise nothing is
    known.
    """
    tangent = problem.linearise(displacement).tangent
    try:
        found = backend.factorise(tangent[0].numpy()).stability
    except SingularMatrix:  # at the critical load itself
        found = 1
    return found if problem.has_potential or found <= 0 else UNKNOWN


def forcing_term(residual: float, previous: float, *, tol: float, corotational: bool) -> float:
    """Return the relative residual at which the linear solve of a Newton step may stop [-].

    It is as large as the convergence of Newton's method allows. The residuals are relative, that of
    the last state NaN if there is none. With `corotational` the first step may be inexact.

    Source: Eisenstat, Walker (1996), SIAM J. Sci. Comput. 17, choice 2.
    """
    enough = 0.1 * tol / residual if residual > 0 else 0.0
    first = 1e-3 if corotational else 0.0
    earned = 0.01 * min(residual / previous, 1.0) ** 2 if previous > 0 else first
    return max(1e-12, enough, min(1e-3, earned))

"""Conjugate gradients and GMRES, and the iterative backend for large bodies."""

import importlib
import importlib.util
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from typing import Any, cast

import numpy as np
import torch
from scipy.sparse import csr_array, csr_matrix
from scipy.sparse.linalg import LinearOperator, gmres
from torch import Tensor

from dpl.fem.linear.interface import (
    UNKNOWN,
    Array,
    Factor,
    Pattern,
    SingularMatrix,
    SymmetricProduct,
    full_matrix,
    require_finite,
    row_numbers,
)

Map = Callable[[Array], Array]  # (n,) -> (n,)
TensorMap = Callable[[Tensor], Tensor]  # (..., n) -> (..., n)
_Step = tuple[Any, Tensor, Tensor, Tensor, Tensor]  # steps, x, residual, direction, r . z
DEFINITENESS_TOL = 1e-6  # relative residual of a random system that proves definiteness
MAX_STEPS = 60  # GMRES steps with the factor of the symmetric part
CYCLES = 2  # the second one corrects what preconditioned and true residual differ by


class NotDefinite(SingularMatrix):
    """The matrix has an eigenvalue that is negative or zero."""


def conjugate_gradients(
    product: Map,
    precondition: Map,
    right: Array,
    rtol: float,
    max_iter: int,
    *,
    abort_if_slow: bool = False,
    natural: bool = False,
) -> Array:
    """Return x, (n,), with ||right - K x|| <= rtol ||right||.

    M is symmetric positive definite and near K. The residual is that of the recurrence; rounding
    limits the true one. `natural` takes the norm sqrt(r . M^-1 r) instead of the Euclidean norm.
    With `abort_if_slow` the iteration stops after three or more steps if the residual, at its mean
    rate of convergence, would not reach `rtol` within `max_iter`. A `SingularMatrix` is raised if K
    is not positive definite or `max_iter` is not enough.

    Source: Hestenes, Stiefel (1952), J. Res. Natl. Bur. Stand. 49; Saad (2003), Iterative Methods
    for Sparse Linear Systems, algorithm 9.1.
    """
    if not right.any():
        return np.zeros_like(right)
    first, unit = 0.0, binary_unit(right)
    for k, state in enumerate(krylov_steps(product, precondition, right / unit)):
        if not state.is_definite:
            raise NotDefinite("the matrix is not positive definite: negative curvature")
        square = float(state.residual @ (state.preconditioned if natural else state.residual))
        first = first if k else square
        if k and square <= rtol**2 * first:
            return unit * state.solution
        is_slow = abort_if_slow and k >= 3 and (square / first) ** (max_iter / (2 * k)) > rtol
        if is_slow or k == max_iter:
            break
    raise SingularMatrix(f"no convergence to {rtol:g} in {max_iter} conjugate gradient steps")


def conjugate_gradients_of_tensors(
    product: TensorMap,
    precondition: TensorMap,
    right: Tensor,
    rtol: float,
    max_steps: int,
) -> Tensor:
    """Return x, (..., n), with K x = f for a batch, as tensor operations.

    Arguments are those of `conjugate_gradients` with its norm `natural`. Systems whose residual is
    below `rtol` are left as they are, and `max_steps` may be too few. An exported graph contains
    the step once, in a loop.
    """
    size = right.abs().amax(dim=-1, keepdim=True)  # squares of a scaled force do not overflow
    size = torch.where(size > 0, size, 1.0)
    right = (right / size).contiguous()
    first = precondition(right).contiguous()
    before = (right * first).sum(dim=-1, keepdim=True)
    least = rtol**2 * before

    def step(k: Any, x: Tensor, residual: Tensor, direction: Tensor, rz: Tensor) -> _Step:
        image = product(direction)
        is_open = rz > least
        curvature = torch.where(is_open, (direction * image).sum(dim=-1, keepdim=True), 1.0)
        length = torch.where(is_open, rz / curvature, 0.0)
        x, residual = x + length * direction, residual - length * image
        z = precondition(residual).contiguous()
        new = (residual * z).sum(dim=-1, keepdim=True)
        return k + 1, x, residual, z + new / torch.where(is_open, rz, 1.0) * direction, new

    def is_open(k: Any, x: Tensor, residual: Tensor, direction: Tensor, rz: Tensor) -> Tensor:
        return (k < max_steps) & (rz > least).any()

    zero = torch.zeros_like(right)
    if torch.compiler.is_compiling():
        counter = torch.zeros((), dtype=torch.int64, device=right.device)
        start = counter, zero, right.clone(), first.clone(), before.clone()
        return size * cast("_Step", torch.while_loop(is_open, step, start))[1]
    state: _Step = (0, zero, right, first, before)
    while is_open(*state):
        state = step(*state)
    return size * state[1]


def solve_unsymmetric(
    pattern: Pattern,
    symmetric: Array,
    skew: Array,
    precondition: Map,
    right: Array,
    rtol: float,
    max_steps: int = MAX_STEPS,
) -> Array:
    """Return x, (n,), with ||right - K x|| <= rtol ||right||, by GMRES, or raise a SingularMatrix.

    `symmetric` and `skew` are the entries of (K + K^T) / 2 and of (K - K^T) / 2 on the pattern,
    (nnz,); -skew solves with K^T. M need not be symmetric. A cycle has, and stores, at most
    `max_steps` vectors. On bodies of 15,000 unknowns a symmetric factorisation with a few steps
    takes a tenth of the time of an unsymmetric one by SuperLU.
    """
    shape = pattern.size, pattern.size
    upper = csr_array((symmetric + skew, pattern.indices, pattern.indptr), shape=shape)
    lower = csr_array((symmetric - skew, pattern.indices, pattern.indptr), shape=shape).T
    diagonal = symmetric[pattern.indptr[:-1]]
    matrix = LinearOperator(shape, lambda x: upper @ x + lower @ x - diagonal * x, dtype=float)
    inverse = LinearOperator(shape, precondition, dtype=float)
    x, failed = gmres(
        matrix, right, M=inverse, rtol=rtol, atol=0.0, restart=max_steps, maxiter=CYCLES
    )
    if failed or not np.isfinite(x).all():
        raise SingularMatrix(f"no convergence to {rtol:g} in {max_steps} GMRES steps")
    return np.asarray(x)


def binary_unit(vector: Array) -> float:
    """Return the power of two over which squares of a vector neither under- nor overflow."""
    largest = float(np.abs(vector).max(initial=0.0))
    return float(2.0 ** np.clip(np.frexp(largest)[1], -1021, 1023))


@dataclass(eq=False)
class KrylovState:
    """State of conjugate gradients, valid until the next step."""

    solution: Array  # x, (n,)
    residual: Array  # right - K x, (n,)
    precondition: Map  # as of `conjugate_gradients`
    lanczos: tuple[list[float], list[float]]  # (off-)diagonal of the tridiagonal matrix of steps
    is_definite: bool = True  # false after a direction of negative curvature

    @cached_property
    def preconditioned(self) -> Array:
        """M^-1 (right - K x), (n,)."""
        return self.precondition(self.residual)

    @property
    def ritz(self) -> float:
        """Smallest Ritz value of M^-1 K; infinite without a step, -inf if K is indefinite."""
        diagonal, off_diagonal = self.lanczos
        if not (diagonal and self.is_definite):
            return math.inf if self.is_definite else -math.inf
        matrix = np.diag(diagonal) + np.diag(off_diagonal, -1)  # the lower triangle is read
        return float(np.linalg.eigvalsh(matrix)[0])


def krylov_steps(product: Map, precondition: Map, right: Array) -> Iterator[KrylovState]:
    """Yield the initial state of conjugate gradients from zero and the state after each step.

    The iteration ends after a direction of negative curvature and at the solution.

    Source: Saad (2003), Iterative Methods for Sparse Linear Systems, section 6.7.3 (Ritz values
    from conjugate gradients).

    The arguments are those of `conjugate_gradients`; the right-hand side is of order one.
    """
    diagonal, off_diagonal = list[float](), list[float]()
    state = KrylovState(np.zeros_like(right), right, precondition, (diagonal, off_diagonal))
    yield state
    direction, rz, carried = state.preconditioned, float(right @ state.preconditioned), 0.0
    while rz != 0:
        image = product(direction)
        curvature = float(direction @ image)
        if not (curvature > 0 and rz > 0):
            yield replace(state, is_definite=False)
            return
        length = rz / curvature
        diagonal.append(1 / length + carried)
        x, residual = state.solution + length * direction, state.residual - length * image
        yield (state := replace(state, solution=x, residual=residual))
        rz, before = float(residual @ state.preconditioned), rz
        ratio = rz / before
        carried = ratio / length
        off_diagonal.append(math.sqrt(max(ratio, 0.0)) / length)
        direction = state.preconditioned + ratio * direction


def smallest_ritz_value(product: Map, precondition: Map, size: int, steps: int = 8) -> float:
    """Return the smallest Ritz value of M^-1 K, -inf if K is not positive definite.

    M is near K, so that all eigenvalues but a few are near 1 and a few Lanczos steps from a fixed
    random vector find the others. More than three are taken only if the smallest is below 1/2.

    The maps are those of `conjugate_gradients`, for `size` unknowns.
    """
    least, right = math.inf, np.random.default_rng(0).standard_normal(size)
    for k, step in enumerate(islice(krylov_steps(product, precondition, right), steps + 1)):
        least = step.ritz
        if k >= 3 and least > 0.5:
            break
    return least


@dataclass(frozen=True, eq=False)
class CGFactor(Factor):
    """A matrix and its preconditioner."""

    product: SymmetricProduct  # function x -> K x
    precondition: Map  # function r -> M^-1 r, near K^-1 r
    max_iter: int  # largest number of iterations of a solve

    @cached_property
    def stability(self) -> int:
        """0 or, if there are negative eigenvalues, 1; `UNKNOWN` without convergence.

        CG detects negative curvature only in the Krylov space of its right-hand side, so this
        solves with a random one, which has a component along every eigenvector. The residual
        polynomial is 1 at zero and has positive roots only, hence exceeds 1 at a negative
        eigenvalue: a small residual proves that there is none.
        """
        noise = np.random.default_rng(0).standard_normal(len(self.product.diagonal))
        try:
            self.solve(noise, DEFINITENESS_TOL)
        except NotDefinite:
            return 1
        except SingularMatrix:
            return UNKNOWN
        return 0

    def apply(self, right: Array) -> Array:
        """Return M^-1 right, (n,)."""
        return self.precondition(right)

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), see `Factor.solve`."""
        try:
            return conjugate_gradients(self.product, self.precondition, right, rtol, self.max_iter)
        except np.linalg.LinAlgError as error:  # from the coarsest grid's Cholesky
            raise NotDefinite(f"the matrix is not positive definite: {error}") from error


@dataclass(frozen=True, eq=False)
class CG:
    """Conjugate gradients for positive definite matrices; `solve` raises for others.

    With pyamg and the near-nullspace the preconditioner is smoothed aggregation (Vanek, Mandel,
    Brezina 1996, Computing 56), whose number of iterations hardly grows with the body. Otherwise
    it is the diagonal.
    """

    pattern: Pattern  # structure of the matrices
    near_null: Array | None = None  # rigid body modes, (n, k), see `Problem.near_null`

    def factorise(self, values: Array) -> CGFactor:
        """Return the factor, see `Backend.factorise`."""
        require_finite(values)
        product = SymmetricProduct(self.pattern, values.copy())
        if not (product.diagonal > 0).all():
            raise SingularMatrix("the matrix is not positive definite by its diagonal")
        if self.near_null is None or not multigrid_installed():
            inverse = 1 / product.diagonal
            return CGFactor(product, lambda residual: inverse * residual, max_iter=5000)
        pyamg: Any = importlib.import_module("pyamg")
        whole = csr_matrix(full_matrix(self.pattern, values))  # pyamg needs spmatrix, not sparray
        hierarchy = pyamg.smoothed_aggregation_solver(
            whole.tobsr((self._block, self._block)),
            B=self.near_null,
            symmetry="symmetric",
            strength=("symmetric", {"theta": 0.0}),
            smooth=("jacobi", {"weighting": "local"}),  # other weightings draw random numbers
            presmoother=("gauss_seidel", {"sweep": "forward"}),
            postsmoother=("gauss_seidel", {"sweep": "backward"}),
            improve_candidates=None,
            max_coarse=300,
            coarse_solver="cholesky",
        )
        return CGFactor(product, hierarchy.aspreconditioner().matvec, max_iter=300)

    @cached_property
    def _block(self) -> int:
        """Block size: D if all nodes have D fully coupled degrees of freedom, else 1."""
        n, columns = self.pattern.size, self.pattern.indices
        dim = {6: 3, 3: 2}.get(0 if self.near_null is None else self.near_null.shape[1], 1)
        blocks = row_numbers(self.pattern).astype(np.int64) // dim * n + columns // dim
        filled = len(np.unique(blocks)) * dim**2 - n // dim * (dim * (dim - 1) // 2)
        return dim if n % dim == 0 and filled == len(columns) else 1


def multigrid_installed() -> bool:
    """Return True if pyamg is installed."""
    return importlib.util.find_spec("pyamg") is not None

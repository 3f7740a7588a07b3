"""K(0)^-1 for all parameters of a range by conjugate gradients from its inverse for one."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self, cast

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import block_diag, csr_array
from torch import Tensor

from dpl.fem.problem import Problem
from dpl.fem.solvers.parity_factor import OrbitForm
from dpl.fem.solvers.stiffness_terms import StiffnessTerms

Array = NDArray[np.float64]
Integers = NDArray[np.int32]
_State = tuple[Any, Tensor, Tensor, Tensor, Tensor]  # steps, x, residual, direction, r . z

MAX_ERROR = 1e-4  # energy norm of the error over that of the solution [-]
MAX_BOUND = 200  # largest value of `StiffnessIteration.bound`


@dataclass(frozen=True)
class StiffnessIteration:
    """K(0)^-1 f by conjugate gradients, preconditioned with the inverse for one parameter.

    This parameter is the node. The condition number of K(node)^-1 K(0) is bounded for every load
    (`StiffnessTerms.condition_numbers`), and with it the error of a solution, in the energy norm,
    and the number of steps. Neither depends on the number of terms.

    Attributes:
        node: Factors of the node, (T,).
        condition: Bound of the condition number for all parameters [-].
        varies: False if K(0) is the same for all parameters: K(node)^-1 is then the solution.
    """

    node: tuple[float, ...]
    condition: float
    varies: bool

    @classmethod
    def of_terms(cls, terms: StiffnessTerms) -> Self:
        """Return the iteration with the node of the smallest condition number.

        Raises:
            ValueError: The bound of the number of steps exceeds `MAX_BOUND`.
        """
        factors, middle = terms.sampled_factors, terms.factors(terms.problem.reference.material)
        if torch.allclose(factors, middle, rtol=1e-12, atol=0.0):
            return cls(tuple(middle[0].tolist()), 1.0, varies=False)
        candidates = torch.cat([middle, factors])
        worst = [float(terms.condition_numbers(factors, one).max()) for one in candidates]
        best = int(np.argmin(worst))
        found = cls(tuple(candidates[best].tolist()), worst[best], varies=True)
        if found.bound > MAX_BOUND:
            raise ValueError(
                f"the parameters {list(terms.problem.material.parameter_ranges)} change K(0) by "
                f"factors whose ratio is up to {found.condition:.3g}, so that the linear solution "
                f"of this network takes more than {MAX_BOUND} steps; give them smaller ranges, or "
                "use model.base=null (fcnn, cnn, gnn)"
            )
        return found

    @property
    def bound(self) -> int:
        """Number of steps after which the error is at most `MAX_ERROR` for every load.

        Source: Saad (2003), Iterative Methods for Sparse Linear Systems, eq. 6.128.
        """
        root = math.sqrt(self.condition)
        if root - 1 < 1e-6:
            return 1
        return math.ceil(math.log(2 / MAX_ERROR) / math.log((root + 1) / (root - 1)))

    @property
    def rtol(self) -> float:
        """Relative residual, in the norm of K(node)^-1, below which the error is `MAX_ERROR`.

        The squares of this norm and of the energy norm of the error have a ratio between the
        smallest and the largest eigenvalue of K(node)^-1 K(0).
        """
        return MAX_ERROR / math.sqrt(self.condition)

    @property
    def max_steps(self) -> int:
        """Number of steps after which the residual is below `rtol`, at conditions up to 1e8."""
        return 2 * self.bound


class TermMatrices(NamedTuple):
    """Terms of K(0) by parity as sparse matrices of one structure: n equations of all parities.

    Attributes:
        first_entry, columns: CSR structure, (n + 1,) and (nnz,).
        entries: Entries of the T terms and of the springs, (T + 1, nnz).
    """

    first_entry: Integers
    columns: Integers
    entries: Array

    @classmethod
    def of(cls, terms: StiffnessTerms, form: OrbitForm, iteration: StiffnessIteration) -> Self:
        """Return the terms of a body. The springs are what the terms of the node lack."""
        bodies = [*terms.bodies, node_body(terms, iteration)]
        every = [block_diag(form.matrices(body), format="csr") for body in bodies]
        structure = csr_array(sum(abs(one) for one in every))
        structure.sort_indices()
        entries = np.stack([_entries(one, structure) for one in every])
        entries[-1] -= np.array(iteration.node) @ entries[:-1]
        return cls(structure.indptr, structure.indices, entries)

    def at(self, factors: Array) -> csr_array:
        """Return K(0), (n, n), of factors and 1, (T + 1,)."""
        return csr_array((factors @ self.entries, self.columns, self.first_entry))

    def padded(self) -> tuple[Tensor, Tensor]:
        """Return columns (n, w) and entries (T + 1, n, w) in rows of one length w."""
        lengths = np.diff(self.first_entry)
        rows = np.repeat(np.arange(len(lengths)), lengths)
        place = np.arange(len(rows)) - self.first_entry[rows]
        columns = np.zeros((len(lengths), lengths.max()), np.int64)
        columns[rows, place] = self.columns
        entries = np.zeros((len(self.entries), *columns.shape))
        entries[:, rows, place] = self.entries
        return torch.from_numpy(columns), torch.from_numpy(entries)


def node_body(terms: StiffnessTerms, iteration: StiffnessIteration) -> Problem:
    """Return the body, with its foundation, whose stiffness is K(node)."""
    body = terms.problem.reference
    if not iteration.varies:
        return body
    node = torch.tensor(iteration.node, dtype=torch.float64)
    return replace(body, material=terms.body(node).material)


def _entries(matrix: csr_array, structure: csr_array) -> Array:
    """Return the entries of a matrix in the order of a structure that contains its own."""
    size = structure.shape[1]
    found = matrix.tocoo()
    rows = np.repeat(np.arange(structure.shape[0]), np.diff(structure.indptr))
    places = np.searchsorted(
        rows * size + structure.indices, found.coords[0] * size + found.coords[1].astype(np.int64)
    )
    return np.bincount(places, found.data, structure.nnz).astype(np.float64)


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    right: Tensor,
    rtol: float,
    max_steps: int,
) -> Tensor:
    """Return K^-1 f, (..., n), as tensor operations.

    Systems whose residual is below `rtol` are left as they are. An exported graph contains the step
    once, in a loop. See `dpl.fem.linear.krylov.conjugate_gradients` for arrays.

    Args:
        product: Function x -> K x, (..., n).
        precondition: Function r -> M^-1 r, (..., n), symmetric positive definite.
        right: f, (..., n).
        rtol: Norm sqrt(r . M^-1 r) of the residual over that of f at which to stop [-].
        max_steps: Largest number of steps.
    """
    size = right.abs().amax(dim=-1, keepdim=True)  # squares of a scaled force do not overflow
    size = torch.where(size > 0, size, 1.0)
    right = (right / size).contiguous()
    first = precondition(right).contiguous()
    before = (right * first).sum(dim=-1, keepdim=True)
    least = rtol**2 * before

    def step(k: Any, x: Tensor, residual: Tensor, direction: Tensor, rz: Tensor) -> _State:
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
        return size * cast("_State", torch.while_loop(is_open, step, start))[1]
    state: _State = (0, zero, right, first, before)
    while is_open(*state):
        state = step(*state)
    return size * state[1]

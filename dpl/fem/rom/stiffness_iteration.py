"""K(0)^-1 for all parameters of a range by conjugate gradients from its inverse for one."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self, cast

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from dpl.fem.linear.condensation import CONVERGED, Condensed, condensed_iteration
from dpl.fem.solvers.parity_factor import OrbitForm
from dpl.fem.solvers.stiffness_terms import StiffnessTerms

Array = NDArray[np.float64]
Integers = NDArray[np.int32]
_State = tuple[Any, Tensor, Tensor, Tensor, Tensor]  # steps, x, residual, direction, r . z

MAX_ERROR = 1e-4  # energy norm of the error over that of the solution [-]
MAX_STEPS = 200  # largest value of `StiffnessIteration.bound`
PROBES = 16  # parameters for which the number of steps is measured
LONG = 2  # factor on the number of steps of the measurement, see `count_steps`


@dataclass(frozen=True)
class StiffnessIteration:
    """K(0)^-1 f by conjugate gradients, preconditioned with the inverse for one parameter.

    This parameter is the node. The method is for bodies whose stiffness has three or more terms.
    Their matrices have no common eigenbasis, so that weights which are the same for every load, see
    `StiffnessInterpolation`, have no bound of their error and need many nodes. The number of steps
    does not depend on the number of terms but on the condition number of K(node)^-1 K(0), of which
    a bound for every load is known (`StiffnessTerms.condition_numbers`).

    Attributes:
        node: Factors of the node, (T,).
        condition: Bound of the condition number for all parameters [-].
    """

    node: tuple[float, ...]
    condition: float

    @classmethod
    def of_terms(cls, terms: StiffnessTerms) -> Self:
        """Return the iteration with the node of the smallest condition number.

        Raises:
            ValueError: The bound of the number of steps exceeds `MAX_STEPS`.
        """
        factors = terms.sampled_factors
        candidates = torch.cat([terms.factors(terms.problem.reference.material), factors])
        worst = [float(terms.condition_numbers(factors, one).max()) for one in candidates]
        best = int(np.argmin(worst))
        found = cls(tuple(candidates[best].tolist()), worst[best])
        if found.bound > MAX_STEPS:
            raise ValueError(
                f"the parameters {list(terms.problem.material.parameter_ranges)} change K(0) by "
                f"factors whose ratio is up to {found.condition:.3g}, so that the linear solution "
                f"of this network takes more than {MAX_STEPS} steps; give them smaller ranges, or "
                "use model.base=none (fcnn, cnn, gnn)"
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


def check_terms(terms: StiffnessTerms) -> None:
    """Check that linear solutions for all parameters can be computed.

    Raises:
        ValueError: See `StiffnessIteration.of_terms`.
    """
    if len(terms) > 2:
        StiffnessIteration.of_terms(terms)


class TermMatrices(NamedTuple):
    """Terms of K(0) by parity as sparse matrices of one structure: equations of m orbits.

    Attributes:
        first_entry, columns: CSR structure, (m + 1,) and (nnz,).
        entries: Entries of the T terms and of the springs, by parity, (T + 1, M, nnz).
    """

    first_entry: Integers
    columns: Integers
    entries: Array

    @classmethod
    def of(cls, terms: StiffnessTerms, form: OrbitForm) -> Self:
        """Return the terms of a body."""
        matrices = [form.matrices(body) for body in terms.bodies]
        if terms.problem.springs is not None:
            law = terms.bodies[0].material
            both = form.matrices(replace(terms.problem.reference, material=law))
            matrices.append([a - b for a, b in zip(both, matrices[0], strict=True)])
        else:
            matrices.append([0 * one for one in matrices[0]])
        every = [one for row in matrices for one in row]
        structure = csr_array(sum(abs(one) for one in every))
        structure.sort_indices()
        entries = [_entries(one, structure) for one in every]
        shape = len(matrices), len(matrices[0]), -1
        return cls(
            structure.indptr.astype(np.int32),
            structure.indices.astype(np.int32),
            np.stack(entries).reshape(shape),
        )

    def at(self, factors: Array) -> Array:
        """Return the entries of K(0), (M, nnz), of factors and 1, (T + 1,)."""
        return np.tensordot(factors, self.entries, 1)

    def padded(self) -> tuple[Tensor, Tensor]:
        """Return columns (m, w) and entries (T + 1, M, m, w) in rows of one length w."""
        lengths = np.diff(self.first_entry)
        rows = np.repeat(np.arange(len(lengths)), lengths)
        place = np.arange(len(rows)) - self.first_entry[rows]
        columns = np.zeros((len(lengths), lengths.max()), np.int64)
        columns[rows, place] = self.columns
        entries = np.zeros((*self.entries.shape[:2], *columns.shape))
        entries[:, :, rows, place] = self.entries
        return torch.from_numpy(columns), torch.from_numpy(entries)


def _entries(matrix: csr_array, structure: csr_array) -> Array:
    """Return the entries of a matrix in the order of a structure that contains its own."""
    size = structure.shape[1]
    found = matrix.tocoo()
    rows = np.repeat(np.arange(structure.shape[0]), np.diff(structure.indptr))
    places = np.searchsorted(
        rows * size + structure.indices, found.coords[0] * size + found.coords[1].astype(np.int64)
    )
    return np.bincount(places, found.data, structure.nnz).astype(np.float64)


def count_steps(
    iteration: StiffnessIteration,
    terms: StiffnessTerms,
    form: OrbitForm,
    blocks: Condensed,
    matrices: TermMatrices,
) -> int:
    """Return the number of steps after which the relative error is at most `MAX_ERROR`.

    It is measured in the energy norm for random forces and for forces on one degree of freedom, for
    the parameters with the largest condition numbers. It is at most `StiffnessIteration.bound`.

    Args:
        iteration: The iteration.
        terms: Terms of K(0).
        form: Orbits of the body.
        blocks: Blocks of the node, (M, V).
        matrices: The terms as matrices.
    """
    factors = terms.sampled_factors
    node = torch.tensor(iteration.node, dtype=torch.float64)
    order = terms.condition_numbers(factors, node).argsort(descending=True)
    random = np.random.default_rng(0)
    size, most = form.orbits.images.numel(), LONG * iteration.bound
    found = 1
    for row in factors[order[:PROBES]].numpy():
        entries = matrices.at(np.array([*row, 1.0]))
        point = np.zeros(size)
        point[random.integers(size)] = 1.0
        for force in (point, random.standard_normal(size)):
            parts = form.parts(torch.from_numpy(force)).numpy()
            for values, own, part in zip(blocks.values, entries, parts, strict=True):
                matrix = matrices.first_entry, matrices.columns, own
                args = (*blocks.fronts[:2], values, matrix, part, most, np.empty_like(part))
                found = max(found, _steps(condensed_iteration(*args)))
    return min(found, iteration.bound)


def _steps(energies: Array) -> int:
    """Return the number of steps that leave at most `MAX_ERROR`; see `condensed_iteration`."""
    left = energies[::-1].cumsum()[::-1]  # squared error before each step
    return int((left > MAX_ERROR**2 * left[0]).sum())


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    right: Tensor,
    steps: int,
    converged: float = CONVERGED,
) -> Tensor:
    """Return K^-1 f, (..., n), as tensor operations.

    Systems whose error is below `converged` are left as they are. See `condensed_iteration`, which
    does the same for one system. An exported graph contains the step once, in a loop.

    Args:
        product: Function x -> K x, (..., n).
        precondition: Function r -> M^-1 r, (..., n), symmetric positive definite.
        right: f, (..., n).
        steps: Largest number of steps.
        converged: Energy norm of the error over that of the solution [-].
    """
    size = right.abs().amax(dim=-1, keepdim=True)  # squares of a scaled force do not overflow
    size = torch.where(size > 0, size, 1.0)
    right = (right / size).contiguous()
    first = (right * precondition(right)).sum(dim=-1, keepdim=True)
    least = converged**2 * first

    def step(k: Any, x: Tensor, residual: Tensor, direction: Tensor, last: Tensor) -> _State:
        z = precondition(residual).contiguous()
        rz = (residual * z).sum(dim=-1, keepdim=True)
        direction = z + rz / torch.where(last > least, last, 1.0) * direction
        image = product(direction)
        is_open = rz > least
        curvature = torch.where(is_open, (direction * image).sum(dim=-1, keepdim=True), 1.0)
        length = torch.where(is_open, rz / curvature, 0.0)
        return k + 1, x + length * direction, residual - length * image, direction, rz

    def is_open(k: Any, x: Tensor, residual: Tensor, direction: Tensor, last: Tensor) -> Tensor:
        return (k < steps) & (last > least).any()

    zero = torch.zeros_like(right)
    state: _State = (0, zero, right, zero, first)
    if torch.compiler.is_compiling():
        counter = torch.zeros((), dtype=torch.int64, device=right.device)
        start = counter, zero, right.clone(), zero.clone(), first.clone()
        return size * cast("_State", torch.while_loop(is_open, step, start))[1]
    for _ in range(steps):
        state = step(*state)
    return size * state[1]

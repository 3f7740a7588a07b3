"""Factor of K(0) by parity: nested static condensation of the fields of each parity.

K(0) maps fields of one parity to forces of the same parity, see `dpl.fem.parity`. With M
symmetries the blocks have fewer entries than those of the whole matrix, and a solve reads as many
fewer.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import block_diag, coo_array, csr_array
from torch import Tensor

from dpl.fem.linear.condensation import (
    Condensed,
    condense,
    condensed_layers,
    condensed_solves,
    solve_layers,
)
from dpl.fem.linear.interface import Array, Factor, full_matrix
from dpl.fem.parity import Parities, SignedOrbits
from dpl.fem.problem import Problem
from dpl.fem.solvers.stiffness_terms import StiffnessTerms
from dpl.fem.symmetry import SymmetryGroup


class OrbitForm(NamedTuple):
    """K(0) of a body by parity: equations of one value of each of m orbits, for M parities.

    Attributes:
        parities: Symmetries that define the parities.
        orbits: Degrees of freedom of each orbit.
        points: Position of the first one, (m, D).
    """

    parities: Parities
    orbits: SignedOrbits
    points: NDArray[np.float64]

    @classmethod
    def of(cls, problem: Problem, group: SymmetryGroup) -> Self:
        """Return the orbits of a body under its symmetries; none: each value is an orbit."""
        parities = Parities.of(group, problem.shape[1])
        orbits = SignedOrbits.of_field(parities, group, problem.free)
        node = problem.free.nonzero()[orbits.images[0], 0]
        return cls(parities, orbits, problem.points[node].numpy())

    def parts(self, force: Tensor) -> Tensor:
        """Return the products of a force at free degrees of freedom, (n,), with fields, (M, m)."""
        return self.orbits.by_parity(force, self.parities)

    def matrices(self, problem: Problem) -> list[csr_array]:
        """Return C^T K(0) C, (m, m), of the fields C of each parity; see `of`."""
        whole = full_matrix(problem.pattern, problem.stiffness_at_rest().numpy())
        return [_block(whole, self.orbits, factors) for factors in self.parities.characters]


@dataclass(frozen=True, eq=False)
class ParityFactor(Factor):
    """Nested condensation of K(0) for one value of each of m orbits, M parities.

    Attributes:
        blocks: Blocks of the parities in float32.
        orbits: Degrees of freedom of each orbit.
        characters: Factor of each parity under each symmetry, (M, M).
        negative_pivots: 0.
    """

    blocks: Condensed
    orbits: SignedOrbits
    characters: Tensor
    negative_pivots: int = 0

    @classmethod
    def of(cls, problem: Problem, group: SymmetryGroup) -> Self:
        """Factorise K(0) of a body.

        Raises:
            SingularMatrix: K(0) is not positive definite.
        """
        form = OrbitForm.of(problem, group)
        fronts, values = condense(form.matrices(problem), form.points)
        blocks = Condensed(fronts, values.astype(np.float32))
        return cls(blocks, form.orbits, form.parities.characters)

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), with K x = right, in the accuracy of float32."""
        images, signs, scales, characters = self._arrays
        parts = characters @ (scales * right[images])
        solved = np.empty_like(parts)
        table, unknowns, _ = self.blocks.fronts
        condensed_solves(table, unknowns, self.blocks.values, parts, solved)
        x = np.empty_like(right)
        x[images] = signs * (characters.T @ solved)
        return x

    def solve_many(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return the solutions, (k, n), in the accuracy of float32, see `Factor.solve_many`."""
        size = np.abs(right).max(axis=1, keepdims=True, initial=0)  # of order one in float32
        size[size == 0] = 1
        images, signs, scales, characters = self._arrays
        parts = torch.from_numpy(characters @ (scales * (right / size)[:, images]))  # (k, M, m)
        layers = condensed_layers(self.blocks, "cpu")
        solved = solve_layers(layers, parts.transpose(0, 1).float()).transpose(0, 1).numpy()
        x = np.empty_like(right)
        x[:, images] = signs * (characters.T @ solved)
        return x * size

    @cached_property
    def _arrays(self) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """Images and signs of the orbits, signs times weights, (M, m), and the characters."""
        images, signs, weights = (part.numpy() for part in self.orbits)
        return images, signs, signs * weights, self.characters.numpy()


def _block(whole: csr_array, orbits: SignedOrbits, characters: Tensor) -> csr_array:
    """Return C^T K C, (m, m), of the fields C of one parity, one for each orbit.

    The field of an orbit that the parity does not allow is zero; it gets a one on the diagonal.
    """
    count = len(orbits.weight)
    values = characters[:, None] * orbits.sign * orbits.weight
    columns = np.tile(np.arange(count), len(characters))
    places = orbits.images.flatten().numpy(), columns
    shape = whole.shape[0], count
    fields = coo_array((values.flatten().numpy(), places), shape=shape).tocsr()
    squares = np.asarray(fields.power(2).sum(axis=0)).ravel()
    missing = np.flatnonzero(squares < 1e-6)
    ones = coo_array((np.ones(len(missing)), (missing, missing)), shape=(count, count))
    return (fields.T @ whole @ fields + ones).tocsr()


class TermMatrices(NamedTuple):
    """Terms of K(0) by parity as sparse matrices of one structure: n equations of all parities.

    Attributes:
        first_entry, columns: CSR structure, (n + 1,) and (nnz,).
        entries: Entries of the T terms and of the springs, (T + 1, nnz).
    """

    first_entry: NDArray[np.int32]
    columns: NDArray[np.int32]
    entries: Array

    @classmethod
    def of(cls, terms: StiffnessTerms, form: OrbitForm) -> Self:
        """Return the terms of a body. The springs are what the terms of the node lack."""
        bodies = [*terms.bodies, terms.node_body]
        every = [block_diag(form.matrices(body), format="csr") for body in bodies]
        structure = csr_array(sum(abs(one) for one in every))
        structure.sort_indices()
        entries = np.stack([_entries(one, structure) for one in every])
        entries[-1] -= terms.node[0].numpy() @ entries[:-1]
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


def _entries(matrix: csr_array, structure: csr_array) -> Array:
    """Return the entries of a matrix in the order of a structure that contains its own."""
    size = structure.shape[1]
    found = matrix.tocoo()
    rows = np.repeat(np.arange(structure.shape[0]), np.diff(structure.indptr))
    places = np.searchsorted(
        rows * size + structure.indices, found.coords[0] * size + found.coords[1].astype(np.int64)
    )
    return np.bincount(places, found.data, structure.nnz).astype(np.float64)

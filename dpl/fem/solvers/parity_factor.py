"""Factor of K(0) by parity: nested static condensation of the fields of each parity.

K(0) maps fields of one parity to forces of the same parity, see `dpl.fem.parity`. With M
symmetries the blocks have fewer entries than those of the whole matrix, and a solve reads as many
fewer.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from torch import Tensor

from dpl.fem.linear.condensation import (
    Condensed,
    condense,
    condensed_block_solve,
    condensed_solves,
)
from dpl.fem.linear.interface import Array, Factor, full_matrix
from dpl.fem.parity import Parities, SignedOrbits
from dpl.fem.problem import Problem
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
        parts = characters @ (scales * (right / size)[:, images])  # (k, M, m)
        solved = np.empty_like(parts)
        for p, values in enumerate(self.blocks.values):
            own = np.ascontiguousarray(parts[:, p].T, np.float32)
            condensed_block_solve(self.blocks.fronts, values, own)
            solved[:, p] = own.T
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

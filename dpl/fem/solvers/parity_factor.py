"""Factor of K(0) by parity: nested static condensation of the fields of each parity.

K(0) maps fields of one parity to forces of the same parity, see `dpl.fem.parity`. With M
symmetries the blocks have fewer entries than those of the whole matrix, and a solve reads as many
fewer.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numba import float32, float64, int64, njit, void
from numba.types import Array as Typed
from numpy.typing import NDArray
from scipy.sparse import block_diag, coo_array, csr_array, dia_array
from torch import Tensor

from dpl.fem.linear.condensation import (
    Condensed,
    add_inverses,
    condense,
    condensed_solutions,
    rounded,
)
from dpl.fem.linear.condensed_loops import add_product
from dpl.fem.linear.interface import Array, Factor, full_matrix
from dpl.fem.materials.material import Material
from dpl.fem.parity import Parities, SignedOrbits
from dpl.fem.problem import Problem
from dpl.fem.solvers.stiffness_terms import StiffnessTerms
from dpl.fem.symmetry import SymmetryGroup

MAX_ROUNDING = 1e-4  # relative error of solutions up to which blocks are rounded [-]
VALUES = Typed(float64, 1, "A", readonly=True)
TABLE = Typed(float64, 2, "C", readonly=True)
INDICES = Typed(int64, 2, "C", readonly=True)
PARTS = float32[:, ::1], float64[:, ::1]


class OrbitArrays(NamedTuple):
    """Degrees of freedom by parity p and symmetry g, see `dpl.fem.parity`."""

    characters: Array  # factor of parity p under symmetry g, (M, M)
    dofs: NDArray[np.int64]  # images of one degree of freedom of each of m orbits, (M, m)
    signs: Array  # factors of these images, (M, m)
    scales: Array  # the same times the weights of the orbits, (M, m)


@njit([float64(TABLE, INDICES, TABLE, VALUES, TABLE, parts) for parts in PARTS], cache=True)
def split_field(characters, dofs, scales, field, support, parts):  # type: ignore[no-untyped-def]
    """Set parts (M, m) by parity of a field (n,) minus `support` (M, m), over a unit; return it.

    The unit is of the size of the largest entry, so that parts in float32 neither underflow
    nor overflow.
    """
    own, whole = np.empty(dofs.shape), np.empty(dofs.shape[1])
    largest = 0.0
    for g in range(len(dofs)):
        for j in range(dofs.shape[1]):
            own[g, j] = scales[g, j] * field[dofs[g, j]]
            size = abs(own[g, j]) + abs(support[g, j])
            if size > largest:
                largest = size
    unit = largest if largest > 0 else 1.0
    for p in range(len(dofs)):  # numba compiles the assignment of an array for two seconds
        for j in range(len(whole)):
            whole[j] = -support[p, j]
        add_product(characters[p], own, whole)
        for j in range(len(whole)):
            parts[p, j] = whole[j] / unit
    return unit


@njit([void(TABLE, INDICES, TABLE, parts, float64, float64[::1]) for parts in PARTS], cache=True)
def join_field(characters, dofs, signs, parts, unit, field):  # type: ignore[no-untyped-def]
    """Set a field (n,) at the degrees of freedom `dofs` from its parts over a unit (M, m)."""
    own = np.empty(dofs.shape[1])
    for g in range(len(dofs)):
        own[:] = 0.0
        add_product(unit * characters[:, g], parts, own)
        for j in range(dofs.shape[1]):
            field[dofs[g, j]] = signs[g, j] * own[j]


class OrbitForm(NamedTuple):
    """K(0) of a body by parity: equations of one value of each of m orbits, for M parities."""

    parities: Parities  # symmetries that define the parities
    orbits: SignedOrbits  # degrees of freedom of each orbit
    points: NDArray[np.float64]  # position of the first one, (m, D)

    @classmethod
    def of(cls, problem: Problem, group: SymmetryGroup) -> Self:
        """Return the orbits of a body under its symmetries; none: each value is an orbit."""
        parities = Parities.of(group, problem.shape[1])
        orbits = SignedOrbits.of_field(parities, group, problem.free)
        node = problem.free.nonzero()[orbits.images[0], 0]
        return cls(parities, orbits, problem.points[node].numpy())

    def arrays(self, numbers: NDArray[np.int64]) -> OrbitArrays:
        """Return the arrays of compiled loops; `numbers` (n,) of the free degrees of freedom."""
        images, signs, weights = (part.numpy() for part in self.orbits)
        characters = self.parities.characters.numpy()
        return OrbitArrays(characters, numbers[images], signs, signs * weights)

    def parts(self, force: Tensor) -> Tensor:
        """Return the products of a force at free degrees of freedom, (n,), with fields, (M, m)."""
        return torch.stack([self.orbits.products(force, one) for one in self.parities.characters])

    def matrices(self, problem: Problem) -> list[csr_array]:
        """Return C^T K(0) C, (m, m), of the fields C of each parity, one for each orbit.

        The field of an orbit that the parity does not allow is zero; it gets a one on the diagonal.
        """
        whole = full_matrix(problem.pattern, problem.stiffness_at_rest().numpy())
        orbits, count, parts = self.orbits, len(self.orbits.weight), []
        shape = whole.shape[0], count
        for characters in self.parities.characters:
            values = (characters[:, None] * orbits.sign * orbits.weight).flatten().numpy()
            columns = np.tile(np.arange(count), len(characters))
            places = orbits.images.flatten().numpy(), columns
            fields = coo_array((values, places), shape=shape).tocsr()
            is_missing = np.asarray(fields.power(2).sum(axis=0)).ravel() < 1e-6
            ones = dia_array((is_missing[None].astype(float), [0]), shape=(count, count))
            parts.append((fields.T @ whole @ fields + ones).tocsr())
        return parts


class Inverse(NamedTuple):
    """K(0)^-1 of one law by parity: a weighted sum of the inverses of K bodies.

    Attributes:
        blocks: Blocks of K bodies, M parities each.
        weights: Weights of the bodies, (K, 1, 1), of the type of the blocks.
    """

    blocks: Condensed
    weights: NDArray[Any]

    def apply(self, parts: NDArray[Any]) -> NDArray[Any]:
        """Return the products with forces by parity, (M, m) each, in the type of the blocks."""
        if len(self.weights) == 1:
            return condensed_solutions(self.blocks, self.weights[0] * parts)
        forces = (self.weights * parts).reshape(-1, parts.shape[1])
        found = condensed_solutions(self.blocks, forces)
        return found.reshape(-1, *parts.shape).sum(axis=0)


@dataclass(frozen=True, eq=False)
class CondensedBody:
    """K(0)^-1 of a body for all parameters of its law, by blocks of a few bodies and parities.

    The blocks are computed when they are first used.

    Attributes:
        terms: K(0) by its dependence on the parameters, and the bodies whose blocks are kept.
        form: Values of each orbit of degrees of freedom, by which K(0) is stored.
    """

    terms: StiffnessTerms
    form: OrbitForm

    @classmethod
    def of(cls, problem: Problem, group: SymmetryGroup) -> Self:
        """Take a body, whose law may have ranges, and symmetries of it."""
        loads = problem.follower_loads.constant
        terms = StiffnessTerms.of(replace(problem, follower_loads=loads))
        return cls(terms, OrbitForm.of(problem.reference, group))

    @cached_property
    def supports(self) -> Tensor:
        """Forces of `StiffnessTerms.support_forces` by parity, (T + 1, M m)."""
        forces = self.terms.support_forces()[:, self.terms.problem.free.cpu()]
        return torch.stack([self.form.parts(force).flatten() for force in forces])

    @cached_property
    def blocks(self) -> Condensed:
        """Blocks of K bodies, one matrix for each of M parities, `rounded`.

        They are float64 if the solutions of random forces, or of the moved supports, lose more than
        `MAX_ROUNDING`. Raises a `SingularMatrix` if K(0) is not positive definite.
        """
        bodies, points = self.terms.kept_bodies, self.form.points
        matrices = [matrix for body in bodies for matrix in self.form.matrices(body)]
        exact = condense(matrices, points)
        supports = self.supports.numpy().reshape(len(self.supports), -1, len(points))
        found = rounded(exact, np.tile(supports, (1, len(bodies), 1)))
        moved = np.tensordot(np.append(self.terms.node[0].numpy(), 1.0), supports, 1)
        random = np.random.default_rng(0).standard_normal((len(matrices), len(points)))
        for forces in (random, np.tile(moved, (len(bodies), 1))):
            one, other = (condensed_solutions(blocks, forces) for blocks in (found, exact))
            loss, size = (np.linalg.norm(x, axis=1) for x in (one - other, other))
            if (loss > MAX_ROUNDING * size).any():
                return exact
        return found

    def inverse(self, factors: Tensor) -> Inverse:
        """Return K(0)^-1 of factors (1, T) of the terms, or that of the node if it needs steps."""
        weights = self.terms.weights(factors)[0].numpy()
        used, count = weights.nonzero()[0], len(self.form.parities.characters)
        own = slice(used[0] * count, (used[-1] + 1) * count)
        parts = {"values": self.blocks.values[own], "factors": self.blocks.factors[own]}
        blocks = self.blocks._replace(**parts)
        return Inverse(blocks, weights[used, None, None].astype(blocks.dtype))

    def factor(self, law: Material) -> "ParityFactor":
        """Return the factor of K(0) of a law without ranges, which needs no steps."""
        return ParityFactor(self.inverse(self.terms.factors(law)), self._orbits)

    @cached_property
    def _orbits(self) -> OrbitArrays:
        return self.form.arrays(np.arange(self.terms.problem.pattern.size))


@dataclass(frozen=True, eq=False)
class ParityFactor(Factor):
    """Factor of K(0) by nested condensation, for one value of each of m orbits, M parities."""

    inverse: Inverse
    orbits: OrbitArrays  # free degrees of freedom of each orbit
    negative_pivots: int = 0

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), with K x = right, in the accuracy of the blocks."""
        characters, dofs, signs, scales = self.orbits
        parts, x = np.empty(dofs.shape, self.inverse.blocks.dtype), np.empty_like(right)
        unit = split_field(characters, dofs, scales, right, np.zeros(dofs.shape), parts)
        join_field(characters, dofs, signs, self.inverse.apply(parts), unit, x)
        return x

    def compliance_steps(
        self, places: NDArray[np.int64], out: Array, size: int, rtol: float
    ) -> Iterator[None]:
        """Set the entries of K^-1 at some places, see `Factor.compliance_steps`."""
        characters, dofs, _, scales = self.orbits
        order = np.argsort(dofs, axis=None)
        found = order[np.searchsorted(dofs.ravel()[order], places)]
        orbit = found % dofs.shape[1]  # of the values at the places
        own = np.where(dofs[:, orbit] == places, scales[:, orbit], 0.0)  # (M, k)
        (blocks, weights), signs = self.inverse, characters @ own
        signs = np.tile(signs, (len(weights), 1))
        return add_inverses(blocks, orbit, signs, np.repeat(weights.ravel(), len(own)), out)


class TermMatrices(NamedTuple):
    """Terms of K(0) by parity as sparse matrices of one structure: n equations of all parities."""

    first_entry: NDArray[np.int32]  # of each row, (n + 1,)
    columns: NDArray[np.int32]  # of the entries, (nnz,)
    entries: Array  # entries of the T terms and of the springs, (T + 1, nnz)

    @classmethod
    def of(cls, terms: StiffnessTerms, form: OrbitForm) -> Self:
        """Return the terms of a body. The springs are what the terms of the node lack."""
        bodies = [*terms.bodies, terms.node_body]
        every = [block_diag(form.matrices(body), format="csr") for body in bodies]
        structure = csr_array(sum(abs(one) for one in every))
        structure.sort_indices()
        size, entries = structure.shape[1], np.zeros((len(every), structure.nnz))
        rows = np.repeat(np.arange(size), np.diff(structure.indptr))
        for own, one in zip(entries, every, strict=True):
            i, j = one.tocoo().coords
            places = np.searchsorted(rows * size + structure.indices, i * size + j.astype(np.int64))
            own[:] = np.bincount(places, one.data, structure.nnz)
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

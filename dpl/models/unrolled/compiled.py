"""Prediction of an unrolled reduced solver by one compiled call."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem.assembly.kernels import call_compiled, constants_of
from dpl.fem.assembly.numba_laws import Law, required_terms
from dpl.fem.assembly.simd import SIMD_WIDTH
from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.parity import Parities, SignedOrbits
from dpl.fem.rom.reduced_stiffness import ReducedInverse
from dpl.fem.symmetry import SymmetryGroup
from dpl.models.unrolled.loops import (
    SOURCES,
    BasisArrays,
    MapArrays,
    ModelArrays,
    OrbitArrays,
    predict,
)

Array = NDArray[np.float64]


class LawArguments(NamedTuple):
    """A law as the first arguments of `predict`."""

    key: Law
    constants: Array
    required_terms: int
    finite: float


def law_arguments(law: InvariantBasedMaterial) -> LawArguments:
    """Return a law as the arguments of a compiled loop.

    Its constants are followed by mu and lambda, (1, n + 2) or (C, n + 2).

    Args:
        law: The law of the sample cells in the order of the loop.
    """
    rows = [constants_of(law)[0], *(np.reshape(one, (-1, 1)) for one in (law.mu, law.lam))]
    count = max(map(len, rows))
    constants = np.concatenate([np.broadcast_to(row, (count, row.shape[1])) for row in rows], 1)
    terms = required_terms(law.compiled_form), float(law.finite)
    return LawArguments(Law.of(law.compiled_form, SOURCES), constants, *terms)


@dataclass(frozen=True)
class CompiledPrediction:
    """An unrolled reduced solver for one load at a time.

    Attributes:
        arrays: Its matrices.
        cells: Position among the sample cells of each cell of the loops, (C,).
    """

    arrays: ModelArrays
    cells: Tensor

    @classmethod
    def of(
        cls,
        group: SymmetryGroup,
        free: Tensor,
        *,
        parity: Tensor,
        modes: Tensor,
        positions: Tensor,
        gradients: Tensor,
        first_map: Tensor,
        maps: Tensor,
        limits: Tensor,
    ) -> Self:
        """Arrange the matrices by parity.

        Args:
            group: Symmetries of the body.
            free: Mask of free degrees of freedom, (N, D).
            parity: Parity of each mode, (R,).
            modes: V at free degrees of freedom, (n, R).
            positions: Position to which each symmetry maps each sample cell, (G, C).
            gradients: G and the gradients of the prescribed displacement, (R + 1, C, D, D).
            first_map: B_0, (C D D, R).
            maps: B_1, ..., (K, 2 C D D, R).
            limits: Largest ratio of each correction to the one before, (1 + K,).
        """
        dim = free.shape[1]
        parities = Parities.of(group, dim)
        fields = SignedOrbits.of_field(parities, group, free)
        images = positions[parities.members]
        one, two = (SignedOrbits.of_tensors(parities, images, k, SIMD_WIDTH) for k in (1, 2))
        of_modes = _ByParity(parities, parity)
        flat = gradients.flatten(1).T  # (C D D, R + 1)
        rest = torch.where(one.weight > 0, flat[one.images, -1], 0.0)
        none = torch.zeros(0, *two.images.shape, of_modes.most)
        others = torch.stack([of_modes.rows(two, matrix) for matrix in maps]) if len(maps) else none
        dofs = free.flatten().nonzero()[:, 0]
        arrays = ModelArrays(
            orbits=OrbitArrays(
                characters=parities.characters.numpy(),
                dofs=_integer(dofs[fields.images]),
                signs=_double(fields.sign),
            ),
            basis=of_modes.basis(fields, modes),
            maps=MapArrays(
                gradients=_single(of_modes.rows(one, flat[:, :-1]).mT),
                rest=_double(rest),
                entry_signs=_double(one.sign),
                first_signs=_double(one.sign * one.weight),
                map_signs=_double(two.sign * two.weight),
                first=_single(of_modes.rows(one, first_map)),
                others=_single(others),
                limits=_double(limits),
            ),
        )
        blocks = one.images.unflatten(1, (-1, 9, SIMD_WIDTH))
        return cls(arrays, blocks[:, :, 0].flatten() // dim**2)

    def __call__(
        self,
        law: LawArguments,
        reduced: ReducedInverse,
        parts: Array,
        solution: Array,
        field: Array,
    ) -> None:
        """Set the displacement at free degrees of freedom.

        Args:
            law: The law, see `law_arguments`.
            reduced: (V^T K(0) V)^-1, (R, R), and V^T K(0) p, (R,).
            parts: Nodal forces by parity, (M, m), see `LinearResponse.parts`.
            solution: Their linear solution by parity, (M, m); overwritten.
            field: Displacement, (N, D), contiguous.
        """
        call_compiled(predict, *law, self.arrays, reduced, parts, solution, field.reshape(-1))


class _ByParity:
    """Columns of matrices, grouped by their parity."""

    def __init__(self, parities: Parities, parity: Tensor) -> None:
        """Take the parities of the columns, (R,)."""
        self._own = [(parity == p).nonzero()[:, 0] for p in range(len(parities.members))]
        self._count = len(parity)
        self.most = max(len(columns) for columns in self._own)

    def rows(self, orbits: SignedOrbits, matrix: Tensor) -> Tensor:
        """Return the rows of one value of each orbit, by parity, (M, m, r), of (n, R)."""
        parts = [orbits.of_parity(matrix, columns) for columns in self._own]
        return torch.stack([pad(part, (0, self.most - part.shape[1])) for part in parts])

    def basis(self, orbits: SignedOrbits, modes: Tensor) -> BasisArrays:
        """Return modes (n, R) by parity."""
        columns = [pad(c, (0, self.most - len(c)), value=self._count) for c in self._own]
        return BasisArrays(_integer(torch.stack(columns)), _single(self.rows(orbits, modes).mT))


def _double(tensor: Tensor) -> NDArray[np.float64]:
    return np.ascontiguousarray(tensor.detach().cpu().double().numpy())


def _single(tensor: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(tensor.detach().cpu().float().numpy())


def _integer(tensor: Tensor) -> NDArray[np.int64]:
    return np.ascontiguousarray(tensor.cpu().numpy())

"""Prediction of an unrolled reduced solver by one compiled call."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem.assembly.kernels import call_compiled
from dpl.fem.assembly.numba_laws import Law, required_terms
from dpl.fem.assembly.sampled_loops import SOURCES, ModelArrays, predict
from dpl.fem.assembly.simd import SIMD_WIDTH
from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.rom.parity import Parities, SignedOrbits
from dpl.fem.symmetry import Symmetry

Array = NDArray[np.float64]


class LawArguments(NamedTuple):
    """A law as the first arguments of `predict`."""

    key: Law
    constants: Array
    required_terms: int
    finite: float
    mu: float
    lam: float


def law_arguments(law: InvariantBasedMaterial) -> LawArguments:
    """Return a law with numbers as moduli as the arguments of a compiled loop."""
    moduli = required_terms(law), float(law.finite), float(law.mu), float(law.lam)
    return LawArguments(Law(type(law), SOURCES), np.array(law.constants, dtype=float), *moduli)


@dataclass(frozen=True)
class CompiledPrediction:
    """An unrolled reduced solver for one load at a time.

    Attributes:
        arrays: Its matrices, see `ModelArrays`.
        tol: Relative size of the part of the linear solution that the modes miss, above which a
            load is local.
    """

    arrays: ModelArrays
    tol: float

    @classmethod
    def of(
        cls,
        group: Sequence[Symmetry],
        free: Tensor,
        *,
        parity: Tensor,
        modes: Tensor,
        probes: Tensor,
        positions: Tensor,
        gradients: Tensor,
        first_map: Tensor,
        maps: Tensor,
        limits: Tensor,
        tol: float,
    ) -> Self:
        """Arrange the matrices by parity.

        Args:
            group: Symmetries of the body.
            free: Mask of free degrees of freedom, (N, D).
            tol: See the class.
            parity: Parity of each mode, (R,).
            modes: V at free degrees of freedom, (n, R).
            probes: Fields whose products with a force estimate the missing part, (n, F).
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
        own = [(parity == p).nonzero()[:, 0] for p in range(len(parities.members))]
        most = max(len(columns) for columns in own)

        def by_parity(orbits: SignedOrbits, matrix: Tensor) -> Tensor:
            """Return the rows of one value of each orbit, by parity, (M, m, r)."""
            parts = [orbits.of_parity(matrix, columns) for columns in own]
            return torch.stack([pad(part, (0, most - part.shape[1])) for part in parts])

        flat = gradients.flatten(1).T  # (C D D, R + 1)
        rest = torch.where(one.weight > 0, flat[one.images, -1], 0.0)
        dofs = free.flatten().nonzero()[:, 0]
        spread = probes.new_zeros(free.numel(), probes.shape[1])
        spread[dofs] = probes
        columns = [pad(c, (0, most - len(c)), value=len(parity)) for c in own]
        none = torch.zeros(0, *two.images.shape, most)
        every = torch.stack([by_parity(two, matrix) for matrix in maps]) if len(maps) else none
        arrays = ModelArrays(
            characters=parities.characters.numpy(),
            dofs=_integer(dofs[fields.images]),
            signs=_double(fields.sign),
            weights=_double(fields.weight),
            columns=_integer(torch.stack(columns)),
            modes=_single(by_parity(fields, modes).mT),
            probes=_single(spread),
            gradients=_single(by_parity(one, flat[:, :-1]).mT),
            rest=_double(rest),
            entry_signs=_double(one.sign),
            first_signs=_double(one.sign * one.weight),
            map_signs=_double(two.sign * two.weight),
            first=_single(by_parity(one, first_map)),
            maps=_single(every),
            limits=_double(limits),
        )
        return cls(arrays, tol)

    def __call__(
        self, law: LawArguments, inverse: Array, supports: Array, force: Array, field: Array
    ) -> bool:
        """Set the displacement at free degrees of freedom; return True for a local load.

        The displacement under a local load lacks the linear solution V c.

        Args:
            law: The law, see `law_arguments`.
            inverse: (V^T K(0) V)^-1, (R, R).
            supports: V^T K(0) p, (R,).
            force: Nodal forces, (N, D).
            field: Displacement, (N, D), contiguous.
        """
        flat = np.ascontiguousarray(force).reshape(-1)
        tol = min(self.tol, np.finfo(float).max ** 0.25)
        data = self.arrays, flat, inverse, supports, tol, field.reshape(-1)
        return bool(call_compiled(predict, *law, *data))


def _double(tensor: Tensor) -> NDArray[np.float64]:
    return np.ascontiguousarray(tensor.detach().cpu().double().numpy())


def _single(tensor: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(tensor.detach().cpu().float().numpy())


def _integer(tensor: Tensor) -> NDArray[np.int64]:
    return np.ascontiguousarray(tensor.cpu().numpy())

"""Arrays of an unrolled reduced solver for `dpl.fem.assembly.sampled_loops`."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dpl.fem.assembly.kernels import call_compiled
from dpl.fem.assembly.numba_laws import Law, required_terms
from dpl.fem.assembly.sampled_loops import SOURCES, predict
from dpl.fem.assembly.simd import SIMD_WIDTH
from dpl.fem.materials.invariant_based import InvariantBasedMaterial

Array = NDArray[np.float64]
Single = NDArray[np.float32]


@dataclass(frozen=True)
class CompiledMaps:
    """Arrays of an unrolled reduced solver in the layout of `predict`.

    Attributes:
        gradients: (R + 1, blocks 9 width).
        first: (blocks 9 width, R).
        maps: (K, blocks 18 width, R).
        limits: Largest ratio of each correction to the one before, (1 + K,).
    """

    gradients: Single
    first: Single
    maps: Single
    limits: Array

    @classmethod
    def of(cls, gradients: Single, first: Single, maps: Single, limits: Array) -> "CompiledMaps":
        """Return the arrays of G (R + 1, C, D, D), B_0 (C D D, R), B_k (K, 2 C D D, R), limits."""
        count, dim = gradients.shape[1:3]
        rank = len(gradients) - 1

        def blocks(tensors: Single) -> Single:
            """Return tensors (r, C, F, D, D) as (r, blocks F 9 width), zero in further cells."""
            padded = np.zeros(
                (len(tensors), -(-count // SIMD_WIDTH) * SIMD_WIDTH, tensors.shape[2], 3, 3),
                np.float32,
            )
            padded[:, :count, :, :dim, :dim] = tensors
            shape = (len(tensors), -1, SIMD_WIDTH, tensors.shape[2] * 9)
            return padded.reshape(shape).swapaxes(2, 3).reshape(len(tensors), -1)

        def rows(matrix: Single, features: int) -> Single:
            tensors = matrix.T.reshape(rank, count, features, dim, dim)
            return np.ascontiguousarray(blocks(tensors).T)

        every = [rows(one, 2) for one in maps]
        none = np.zeros((0, 2 * blocks(gradients[:1, :, None]).shape[1], rank), np.float32)
        return cls(
            np.ascontiguousarray(blocks(gradients[:, :, None])),
            rows(first, 1),
            np.stack(every) if every else none,
            limits,
        )

    def __call__(
        self, law: InvariantBasedMaterial, inverse: Array, right: Array
    ) -> tuple[Array, Array]:
        """Return coordinates (R,) of the linear solution and of the prediction.

        Args:
            law: The law, with numbers as moduli.
            inverse: (V^T K(0) V)^-1, (R, R).
            right: V^T f - V^T K(0) p, (R,).
        """
        linear, whole = np.empty_like(right), np.empty_like(right)
        key = Law(type(law), SOURCES)
        constants = np.array(law.constants)
        moduli = required_terms(law), float(law.finite), law.mu, law.lam
        arrays = (self.gradients, self.first, self.maps, self.limits, linear, whole)
        call_compiled(predict, key, constants, *moduli, right, inverse, *arrays)
        return linear, whole

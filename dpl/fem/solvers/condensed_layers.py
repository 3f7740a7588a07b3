"""Nested static condensation as tensor operations, for batches, gradients, GPUs and graphs."""

from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem.linear.condensation import Condensed, front_blocks
from dpl.fem.linear.dissection import Integers


class Layer(NamedTuple):
    """Fronts of the same height and similar sizes, filled to one size; none depends on another.

    Attributes:
        pivots: Pivots of each front, n where there are fewer, (k, I).
        boundary: Their boundaries, n where there are fewer, (k, J).
        inverse: F_II^-1 of P matrices, zero in filled rows and columns, (P, k, I, I).
        coupling: X, (P, k, I, J).
    """

    pivots: Tensor
    boundary: Tensor
    inverse: Tensor
    coupling: Tensor


class CondensedLayers(NamedTuple):
    """Blocks of P matrices as few products of batches of matrices, see `Condensed`.

    Attributes:
        layers: Fronts by height, those without children first.
    """

    layers: tuple[Layer, ...]

    @classmethod
    def of(cls, blocks: Condensed, device: torch.device) -> Self:
        """Return the blocks on a device, in their dtype."""
        table, _, heights = blocks.fronts
        classes = np.rint(2 * np.log2(table[:, 1] - table[:, 0]))  # similar numbers of pivots
        kinds = sorted(set(zip(heights.tolist(), classes.tolist(), strict=True)))
        chosen = (np.flatnonzero((heights == h) & (classes == c)) for h, c in kinds)
        layers = (_layer(blocks, fronts) for fronts in chosen)
        return cls(tuple(Layer(*(part.to(device) for part in layer)) for layer in layers))

    def solve(self, right: Tensor) -> Tensor:
        """Return the solutions (P, B, n) of right-hand sides (P, B, n) of the dtype of the blocks.

        The n-th unknown, where fronts are filled, is always zero.
        """
        force, inner = pad(right, (0, 1)), []
        for layer in self.layers:
            own = force[..., layer.pivots].transpose(1, 2)  # (P, k, B, I)
            inner.append(own @ layer.inverse)
            passed = (own @ layer.coupling).transpose(1, 2).flatten(2)
            force = force.index_add(2, layer.boundary.flatten(), -passed)
        solution = torch.zeros_like(force)
        for layer, own in zip(reversed(self.layers), reversed(inner), strict=True):
            outer = solution[..., layer.boundary].transpose(1, 2)
            found = (own - outer @ layer.coupling.transpose(2, 3)).transpose(1, 2).flatten(2)
            solution = solution.index_add(2, layer.pivots.flatten(), found)
        return solution[..., :-1]


def _layer(blocks: Condensed, numbers: Integers) -> Layer:
    """Return some fronts, by their numbers."""
    fronts, values = blocks
    every = front_blocks(fronts, values)
    chosen = [every[k] for k in numbers]
    size = len(np.unique(fronts.unknowns))
    count = max(len(one.pivots) for one in chosen)
    others = max(1, max(len(one.boundary) for one in chosen))  # graphs have no empty tensors
    shape = len(chosen), count, others
    pivots, boundary = np.full(shape[:2], size), np.full((len(chosen), others), size)
    inverse = np.zeros((len(values), len(chosen), count, count), values.dtype)
    coupling = np.zeros((len(values), *shape), values.dtype)
    for k, one in enumerate(chosen):
        own, other = len(one.pivots), len(one.boundary)
        pivots[k, :own], boundary[k, :other] = one.pivots, one.boundary
        inverse[:, k, :own, :own] = one.inverse
        coupling[:, k, :own, :other] = one.coupling
    return Layer(*map(torch.from_numpy, (pivots, boundary, inverse, coupling)))

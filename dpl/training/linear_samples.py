"""Samples with their linear solutions, which are computed once for a data set."""

from typing import NamedTuple

import torch
from torch import Tensor

from dpl.data.samples import Samples
from dpl.fem import Load
from dpl.fem.symmetry import NO_SYMMETRIES, SymmetryGroup
from dpl.models.linear_base import LinearBase
from dpl.scene import Sample

CHUNK = 256  # loads that are solved at a time


class LinearBatch(NamedTuple):
    """A batch of samples and their linear solutions.

    Attributes:
        linear: Linear solutions, (B, N, D) [-], float32.
        sample: The samples.
    """

    linear: Tensor
    sample: Sample


class LinearSamples(Samples):
    """Samples in memory with their linear solutions, and images of both under symmetries."""

    def __init__(
        self, samples: Sample, base: LinearBase, group: SymmetryGroup = NO_SYMMETRIES
    ) -> None:
        """Compute the linear solutions.

        Args:
            samples: The samples, (S, ...).
            base: Solver.
            group: See `Samples`.
        """
        super().__init__(samples, group)
        self.linear = linear_solutions(samples.load, base)

    def __getitems__(self, indices: list[int]) -> LinearBatch:  # type: ignore[override]
        """Return a batch."""
        count = len(self.linear)
        linear = self.linear[[i % count for i in indices]]
        if self.group:
            linear = self.group.images(linear, torch.tensor([i // count for i in indices]))
        return LinearBatch(linear, super().__getitems__(indices))


def linear_solutions(load: Load, base: LinearBase) -> Tensor:
    """Return the linear solutions of many loads, (S, N, D) [-], float32, solved in chunks."""
    parts = zip(*(column.split(CHUNK) for column in load), strict=True)
    return torch.cat([base.solve(Load(*part)).float() for part in parts])

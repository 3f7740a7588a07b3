"""Samples in memory, and their images under symmetries of their body."""

import torch
from torch import Tensor
from torch.utils.data import Dataset

from dpl.fem.symmetry import NO_SYMMETRIES, SymmetryGroup
from dpl.scene import Sample


class Samples(Dataset):
    """Samples in memory and their images under symmetries, read a batch at a time."""

    def __init__(self, samples: Sample, group: SymmetryGroup = NO_SYMMETRIES) -> None:
        """Store the samples, (B, ...), and the symmetries of their body, identity first."""
        self.samples = samples
        self.group = group

    def __len__(self) -> int:
        """Return B times the number of symmetries."""
        return len(self.samples.force) * max(1, len(self.group))

    def __getitems__(self, indices: list[int]) -> Sample:
        """Return a batch."""
        count = len(self.samples.force)
        batch = Sample(*(column[[i % count for i in indices]] for column in self.samples))
        if not self.group:
            return batch
        return transform(batch, self.group, torch.tensor([i // count for i in indices]))


def transform(batch: Sample, group: SymmetryGroup, which: Tensor) -> Sample:
    """Return samples transformed by symmetries of the body, `which` of them for each, (B,)."""
    force, displacement = (group.images(field, which) for field in batch[:2])
    return batch._replace(force=force, displacement=displacement)

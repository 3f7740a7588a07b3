"""Samples in the few coordinates that a network works on: small enough to stay in a cache."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from dpl.fem.symmetry import Symmetry
from dpl.scene import Sample


class ReducedSamples(NamedTuple):
    """Samples in coordinates; a batch is the same with a leading B.

    Attributes:
        inputs: Of the load, (B, M) [-].
        targets: Of the displacement that is to be learnt, in an orthonormal basis, (B, R) [-].
        rest: Square of what the basis does not reach, (B,) [-].
        size: Mean square of the whole displacement over degrees of freedom, (B,) [-].
    """

    inputs: Tensor
    targets: Tensor
    rest: Tensor
    size: Tensor


class ReducedDataset(Dataset):
    """Samples in coordinates with their images under symmetries, fetched a batch at a time."""

    def __init__(self, samples: ReducedSamples, inputs: Tensor, targets: Tensor) -> None:
        """Make the images.

        Args:
            samples: S of them.
            inputs: What each symmetry does to the inputs, x -> x T, (G, M, M); identity first.
            targets: What it does to the targets, (G, R, R).
        """
        images = len(inputs)
        self.samples = ReducedSamples(
            inputs=(samples.inputs @ inputs).flatten(0, 1),
            targets=(samples.targets @ targets).flatten(0, 1),
            rest=samples.rest.repeat(images),
            size=samples.size.repeat(images),
        )

    def __len__(self) -> int:
        """Return S times the number of symmetries."""
        return len(self.samples.rest)

    def __getitems__(self, indices: list[int]) -> ReducedSamples:
        """Return a batch."""
        chosen = torch.tensor(indices)
        return ReducedSamples(*(column[chosen] for column in self.samples))


class ReducedOrderNet(nn.Module, ABC):
    """A network that works between few coordinates of loads and of displacements.

    `dpl.training.Surrogate` lets it make its bases before training starts and, where the
    loss is a function of squared errors, trains it on samples in coordinates.

    Attributes:
        prepared: Whether its bases are there, ().
        group: The symmetries that it knows; empty: none.
    """

    prepared: Tensor
    group: Sequence[Symmetry]

    @abstractmethod
    def fit_bases(self, samples: Sample, unit: float) -> None:
        """Make the bases of training samples, scaled; `unit`: scale of forces over that of u."""

    @abstractmethod
    def encode(self, samples: Sample) -> ReducedDataset:
        """Return training samples, scaled, in coordinates, with their images."""

    @abstractmethod
    def network(self, inputs: Tensor) -> Tensor:
        """Return coordinates (B, R) of displacements from those of loads (B, M)."""


def projection_error(field: Tensor, coordinates: Tensor) -> Tensor:
    """Return squares (B,) of what of fields (B, N, D) an orthonormal basis does not hold.

    Args:
        field: The fields.
        coordinates: In the basis, (B, R).
    """
    return field.flatten(1).square().sum(dim=1) - coordinates.square().sum(dim=1)


def partial_whitening(size: Tensor) -> Tensor:
    """Return what coordinates of sizes (n,) are divided by, (n,).

    Between whitened and as they are: small ones matter less, but not nothing, and rounding least.
    """
    largest = size.max().clamp(min=1e-30)
    return (size**0.6 * largest**0.4).clamp(min=1e-3 * float(largest))


def root_mean_square(columns: Tensor) -> Tensor:
    """Return the size of each column of (S, n), (n,)."""
    return columns.square().mean(dim=0).sqrt()

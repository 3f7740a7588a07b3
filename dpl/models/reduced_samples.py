"""Samples in the reduced coordinates of a network; a whole data set fits into memory."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.data import Dataset


class ReducedSamples(NamedTuple):
    """Samples in reduced coordinates.

    Attributes:
        inputs: Coordinates of the loads, (B, M) [-].
        targets: Coordinates of the displacements in an orthonormal basis, (B, R) [-].
        squared_error: Squared projection errors of the displacements, (B,) [-].
        mean_square: Mean squares of the displacements over degrees of freedom, (B,) [-].
        factor: Factors of the predictions in the displacements, (B,) [-]; see `LinearBase.gate`.
    """

    inputs: Tensor
    targets: Tensor
    squared_error: Tensor
    mean_square: Tensor
    factor: Tensor


class ReducedDataset(Dataset):
    """Reduced samples and their images under symmetries, indexed by batches."""

    def __init__(
        self, samples: ReducedSamples, input_actions: Tensor, target_actions: Tensor
    ) -> None:
        """Compute the images.

        Args:
            samples: The S samples.
            input_actions: T of each symmetry: inputs x of an image are x T, (G, M, M); identity
                first.
            target_actions: The same for targets, (G, R, R).
        """
        images = len(input_actions)
        self.samples = ReducedSamples(
            inputs=(samples.inputs @ input_actions).flatten(0, 1),
            targets=(samples.targets @ target_actions).flatten(0, 1),
            squared_error=samples.squared_error.repeat(images),
            mean_square=samples.mean_square.repeat(images),
            factor=samples.factor.repeat(images),
        )

    def __len__(self) -> int:
        """Return the number of samples, S G."""
        return len(self.samples.inputs)

    def __getitems__(self, indices: list[int]) -> ReducedSamples:
        """Return the batch of some samples."""
        selected = torch.tensor(indices)
        return ReducedSamples(*(column[selected] for column in self.samples))


def squared_projection_error(field: Tensor, coordinates: Tensor) -> Tensor:
    """Return the squared distances (B,) of fields from the span of an orthonormal basis.

    Args:
        field: Fields, (B, N, D).
        coordinates: Their coordinates in the basis, (B, R).
    """
    return field.flatten(1).square().sum(dim=1) - coordinates.square().sum(dim=1)

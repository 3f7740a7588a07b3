"""What a loss is, and what it knows of a batch."""

from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor

from dpl.fem import Problem
from dpl.scene import Sample


class LossContext(NamedTuple):
    """What a loss may know of the scene.

    Attributes:
        problem: The body, on the device of the batch; with a range of Poisson's ratios that of a
            batch is `problem.at(batch.poisson)`.
        largest_force: ||Phi q_max||, the paper's normaliser of residuals [-].
    """

    problem: Problem
    largest_force: Tensor


class Loss(L.Callback):
    """A loss; subclasses define `__call__` and put what they want logged into `terms`."""

    def __init__(self) -> None:
        """Start with nothing to log."""
        self.terms: dict[str, Tensor] = {}

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """Return the loss of displacements (B, N, D) [-], float64, as a scalar."""
        raise NotImplementedError(f"{type(self).__name__} computes nothing")

    def on_train_batch_end(self, trainer: L.Trainer, module: L.LightningModule, *_: Any) -> None:
        """Log the terms."""
        module.log_dict({f"loss/{name}": term.detach() for name, term in self.terms.items()})

    def skipped_work(self) -> list[str]:
        """Return what this loss leaves out, a line each."""
        return []


def squared_error(prediction: Tensor, batch: Sample) -> Tensor:
    """Return the mean square of (u - v)/L over degrees of freedom, (B,) [-]."""
    return (prediction - batch.displacement).square().mean(dim=(1, 2))


def clamp_scale(sizes: Tensor, floor: float) -> Tensor:
    """Return what to divide samples by: their own sizes (B,), but no less than a part of the mean.

    Without a floor a load near zero, which no network answers to many digits, outweighs a batch.

    Args:
        sizes: Squares or energies, 0 or more.
        floor: Part of their mean; 1e-2 is a tenth of the usual displacement. Infinity: all take
            the mean.
    """
    mean = sizes.mean()
    sizes = mean.expand_as(sizes) if floor == torch.inf else torch.maximum(sizes, floor * mean)
    return torch.where(sizes > 0, sizes, 1.0)


def _checked(floor: float) -> float:
    """Return a floor.

    Raises:
        ValueError: It lies outside [0, 1].
    """
    if not 0 <= floor <= 1:
        raise ValueError(f"floor = {floor} must lie between 0 and 1")
    return floor

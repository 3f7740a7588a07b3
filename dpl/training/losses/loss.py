"""The base class of losses, and functions that they share.

A loss is a callable (prediction, batch, physics) -> scalar and a Lightning callback. The
LightningModule registers it with the trainer (`configure_callbacks`), so that a loss can anneal
between epochs and log its terms. Losses with mechanics take gradients from the compiled forces of
`Problem.evaluate`; automatic differentiation takes 3 to 17 times as long.
"""

from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dpl.fem import Problem
from dpl.scene import Sample


class LossContext(NamedTuple):
    """The part of the scene that losses need.

    Attributes:
        problem: The finite-element problem, on the device of the batch. Where the law has a range
            the problem of a batch is `problem.with_parameters(batch.parameters)`.
        largest_force: ||Phi q_max||, by which the paper divides residuals, () [-].
    """

    problem: Problem
    largest_force: Tensor


class Loss(L.Callback):
    """Base class of losses; subclasses define `__call__`.

    Attributes:
        terms: Scalars of the last batch, logged as `loss/NAME`.
    """

    def __init__(self) -> None:
        """Start without terms."""
        self.terms: dict[str, Tensor] = {}

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """Return the loss of displacements over L, (B, N, D), float64, as a scalar."""
        raise NotImplementedError(f"{type(self).__name__} must define __call__")

    def on_train_batch_end(self, trainer: L.Trainer, module: L.LightningModule, *_: Any) -> None:
        """Log the terms."""
        module.log_dict({f"loss/{name}": term.detach() for name, term in self.terms.items()})

    def skipped_work(self) -> list[str]:
        """Return the work that this loss saves, one line each."""
        return []


def squared_error(prediction: Tensor, batch: Sample) -> Tensor:
    """Return the mean square of (u - v)/L over degrees of freedom, (B,) [-]."""
    return (prediction - batch.displacement).square().mean(dim=(1, 2))


def clamp_scale(sizes: Tensor, floor: float) -> Tensor:
    """Return divisors (B,) of errors: sizes, but at least a fraction of their mean.

    Without a floor a load near zero, whose relative error is always large, dominates a batch.

    Args:
        sizes: Squares or energies, 0 or more, (B,).
        floor: Fraction of the mean size; 1e-2 corresponds to a tenth of the usual displacement.
            Infinity: every divisor is the mean.
    """
    mean = sizes.mean()
    sizes = mean.expand_as(sizes) if floor == torch.inf else torch.maximum(sizes, floor * mean)
    return torch.where(sizes > 0, sizes, 1.0)


def check_floor(floor: float) -> float:
    """Return `floor` for `clamp_scale` if it lies in [0, 1].

    Raises:
        ValueError: `floor` lies outside [0, 1].
    """
    if not 0 <= floor <= 1:
        raise ValueError(f"floor = {floor} must lie between 0 and 1")
    return floor


class PrescribedGradient(torch.autograd.Function):
    """Values (B,) of displacements (B, N, D) with gradients (B, N, D) that the caller computes."""

    @staticmethod
    def forward(ctx: Any, displacement: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
        """Return `value`, (B,)."""
        ctx.save_for_backward(gradient)
        return value.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        """Return the gradient with respect to the displacement, (B, N, D)."""
        (gradient,) = ctx.saved_tensors
        return upstream[:, None, None] * gradient, None, None

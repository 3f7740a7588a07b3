"""The base class of losses, functions that they share, and a blend of two losses.

A loss is a callable (prediction, batch, physics) -> scalar and a Lightning callback, which can
anneal between epochs and log its terms. Losses with mechanics take gradients from the compiled
forces of `Problem.evaluate`; automatic differentiation takes 3 to 17 times as long.
"""

from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor

from dpl.fem import Problem
from dpl.scene import Sample
from dpl.system.checks import check_range


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
        saves: Work that this loss saves, one line each.
        dtype: Precision of the displacements and forces of training batches; energies and
            residuals cancel digits that float32 does not have.
    """

    saves: tuple[str, ...] = ()
    dtype = torch.float64

    def __init__(self) -> None:
        """Start without terms."""
        self.terms: dict[str, Tensor] = {}

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """Return the loss of displacements over L, (B, N, D), of `dtype`, as a scalar."""
        raise NotImplementedError(f"{type(self).__name__} must define __call__")

    def on_train_batch_end(self, trainer: L.Trainer, module: L.LightningModule, *_: Any) -> None:
        """Log the terms."""
        module.log_dict({f"loss/{name}": term.detach() for name, term in self.terms.items()})

    def skipped_work(self) -> list[str]:
        """Return the work that this loss saves, one line each."""
        return list(self.saves)


class BlendedLoss(Loss):
    """(1 - weight) first + weight second, with a weight that rises from 0 to 1.

    Attributes:
        weight: Current weight of the second loss [-].
    """

    def __init__(self, first: Loss, second: Loss, *, epochs: int, start: int = 0) -> None:
        """Choose the two losses and the schedule of the weight.

        Args:
            first: Loss up to the epoch `start`.
            second: Loss from the epoch `start + epochs` on; should have the magnitude of `first`.
            epochs: Number of epochs in which the weight rises linearly from 0 to 1.
            start: Epoch in which the weight begins to rise.
        """
        super().__init__()
        check_range(1, epochs=epochs)
        check_range(0, start=start)
        self.first, self.second = first, second
        self._epochs = epochs
        self._start = start
        self.weight = 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Set the weight of the epoch, and the weights of both losses."""
        passed = (trainer.current_epoch - self._start) / self._epochs
        self.weight = min(1.0, max(0.0, passed))
        for loss in (self.first, self.second):
            loss.on_train_epoch_start(trainer, module)

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """See `Loss`; a loss of weight 0 is not evaluated."""
        total = prediction.new_zeros(())
        self.terms = {"weight": total + self.weight}
        parts = {"first": (1 - self.weight, self.first), "second": (self.weight, self.second)}
        for name, (weight, loss) in parts.items():
            if weight > 0:
                value = loss(prediction, batch, physics)
                total = total + weight * value
                self.terms |= {name: value}
                self.terms |= {f"{name}/{term}": scalar for term, scalar in loss.terms.items()}
        return total

    def skipped_work(self) -> list[str]:
        """Return the work that both losses save, one line each."""
        return [line for line in self.first.skipped_work() if line in self.second.skipped_work()]


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


def with_gradient(displacement: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
    """Return values (B,) whose gradient with respect to displacements (B, N, D) is prescribed.

    Args:
        displacement: The displacements.
        value: The values, without a gradient.
        gradient: The gradient, (B, N, D).
    """
    zero = displacement - displacement.detach()
    return value + (gradient * zero).sum(dim=(1, 2))

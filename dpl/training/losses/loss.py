"""The base class of losses, squared errors, a blend of two losses, and functions for all losses.

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

SMALLEST_SQUARE = 1e-24  # added to squared errors: the root has no gradient at zero [-]


class LossContext(NamedTuple):
    """The part of the scene that losses need, on the device of the batch."""

    problem: Problem  # without parameters; those of a batch are `batch.parameters`
    largest_force: Tensor  # ||Phi q_max||, by which the paper divides residuals, () [-]


class Loss(L.Callback):
    """Base class of losses; subclasses define `__call__`."""

    saves: tuple[str, ...] = ()  # work that this loss saves, one line each
    # precision of displacements and forces of training batches; energies and residuals cancel
    # digits that float32 does not have
    dtype = torch.float64

    def __init__(self) -> None:
        """Start without terms."""
        self.terms: dict[str, Tensor] = {}  # scalars of the last batch, logged as `loss/NAME`

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """Return the loss of displacements over L, (B, N, D), of `dtype`, as a scalar."""
        raise NotImplementedError(f"{type(self).__name__} must define __call__")

    def on_train_batch_end(self, trainer: L.Trainer, module: L.LightningModule, *_: Any) -> None:
        """Log the terms."""
        module.log_dict({f"loss/{name}": term.detach() for name, term in self.terms.items()})


class MSE(Loss):
    """Mean squared error of u/L over all degrees of freedom."""

    saves = ("no finite-element evaluation in training: the loss has no residual term",)
    dtype = torch.float32

    def __init__(self, *, relative: float = 0.0, floor: float = 1e-2) -> None:
        """Choose the weighting.

        Args:
            relative: Exponent of the mean squared displacement by which the error of each sample is
                divided. 1 gives relative errors, 0 absolute errors.
            floor: See `clamp_scale`; has no effect if `relative` is 0.
        """
        super().__init__()
        check_range(0, 1, relative=relative, floor=floor)
        self.relative, self.floor = relative, floor

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        return self.errors(prediction, batch).mean()

    def errors(self, prediction: Tensor, batch: Sample) -> Tensor:
        """Return mean squared errors over powers of mean squared displacements, (B,)."""
        error = (prediction - batch.displacement).square().mean(dim=(1, 2))
        if not self.relative:
            return error
        size = batch.displacement.square().mean(dim=(1, 2))
        return error / clamp_scale(size, self.floor) ** self.relative


class RMSELoss(MSE):
    """Mean over samples of the root mean square error of u/L: e_mean times the root of N.

    Its gradient does not vanish with the error, and samples with large errors dominate a batch less
    than in the mean squared error.
    """

    def errors(self, prediction: Tensor, batch: Sample) -> Tensor:
        """Return the roots of the errors of `MSE`, (B,)."""
        return (super().errors(prediction, batch) + SMALLEST_SQUARE).sqrt()


class BlendedLoss(Loss):
    """(1 - weight) first + weight second, with a weight [-] that rises from 0 to 1."""

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
        self.saves = tuple(line for line in first.saves if line in second.saves)
        self._epochs, self._start, self.weight = epochs, start, 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Set the weight of the epoch, and the weights of both losses."""
        passed = (trainer.current_epoch - self._start) / self._epochs
        self.weight = min(1.0, max(0.0, passed))
        for loss in (self.first, self.second):
            loss.on_train_epoch_start(trainer, module)

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        # a loss of weight 0 is not evaluated
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


def clamp_scale(sizes: Tensor, floor: float) -> Tensor:
    """Return divisors of errors, (B,): squares or energies, but at least `floor` of their mean.

    Without a floor a load near zero, whose relative error is always large, dominates a batch. 1e-2
    corresponds to a tenth of the usual displacement.
    """
    sizes = torch.maximum(sizes, floor * sizes.mean())
    return torch.where(sizes > 0, sizes, 1.0)


def with_gradient(displacement: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
    """Return values (B,) with a prescribed gradient with respect to displacements (B, N, D)."""
    zero = displacement - displacement.detach()
    return value + (gradient * zero).sum(dim=(1, 2))

"""Physics losses: callables (prediction, batch, physics) -> scalar, Lightning callbacks too.

The module carries its loss into the trainer (`configure_callbacks`), so that a loss may anneal
between epochs and log its own terms.

Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 2.3.
"""

from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor

from dpl.fem.problem import Problem
from dpl.scene import Sample

CHUNK = 8  # samples at once: few enough for their stresses to fit a processor's cache


class Physics(NamedTuple):
    """What a loss may know of the scene.

    Attributes:
        problem: The body, on the device of the batch.
        largest_force: ||Phi q_max||, the paper's normaliser of residuals [-].
    """

    problem: Problem
    largest_force: Tensor


class Loss(L.Callback):
    """A loss; subclasses define `__call__` and put what they want logged into `terms`."""

    def __init__(self) -> None:
        """Start with nothing to log."""
        self.terms: dict[str, Tensor] = {}

    def __call__(self, prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
        """Return the loss of displacements (B, N, D) [-], float64, as a scalar."""
        raise NotImplementedError(f"{type(self).__name__} computes nothing")

    def on_train_batch_end(self, trainer: L.Trainer, module: L.LightningModule, *_: Any) -> None:
        """Log the terms."""
        module.log_dict({f"loss/{name}": term.detach() for name, term in self.terms.items()})

    def plan(self) -> list[str]:
        """Return what this loss leaves out, a line each."""
        return []


class MSE(Loss):
    """Mean squared error of u/L over all degrees of freedom."""

    def __call__(self, prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
        """See `Loss`."""
        return squared_error(prediction, batch).mean()

    def plan(self) -> list[str]:
        """See `Loss`."""
        return ["no finite-element evaluation in training: the loss knows no residual"]


class LrStar(Loss):
    """L_r^* = MSE x ||R|| / ||Phi q_max||, the residual a constant weight without gradient.

    The residual norm is averaged over the batch as in the paper, where it scales the gradient of
    the whole batch; per sample it also weighs the samples of a batch against each other.
    """

    def __init__(self, *, per_sample: bool = False) -> None:
        """Choose the weighting.

        Args:
            per_sample: Weigh each sample by its own residual instead of the batch's mean.
        """
        super().__init__()
        self.per_sample = per_sample

    def __call__(self, prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
        """See `Loss`."""
        error = squared_error(prediction, batch)
        with torch.no_grad():
            weight = residual_norm(prediction, batch, physics)
            weight = weight if self.per_sample else weight.mean()
        self.terms = {"mse": error.mean(), "residual": weight.mean()}
        return (error * weight).mean()

    def plan(self) -> list[str]:
        """See `Loss`."""
        return ["no backward pass through the residual: it is a weight"]


class LrPlus(Loss):
    """L_r^+ = MSE + weight ||R|| / ||Phi q_max||, differentiable through the residual.

    Attributes:
        weight: Factor on the residual at present [-].
    """

    def __init__(self, *, weight: float = 1.0, warmup_epochs: int = 0) -> None:
        """Choose how much the residual counts.

        Args:
            weight: Factor on the residual; 1 is the paper's.
            warmup_epochs: Epochs in which it rises linearly from zero.

        Raises:
            ValueError: A number is negative.
        """
        super().__init__()
        if weight < 0 or warmup_epochs < 0:
            raise ValueError(
                f"weight = {weight}, warmup_epochs = {warmup_epochs} must be 0 or more"
            )
        self._final, self._warmup = weight, warmup_epochs
        self.weight = weight if warmup_epochs == 0 else 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Anneal the weight."""
        if self._warmup:
            self.weight = self._final * min(1.0, trainer.current_epoch / self._warmup)

    def __call__(self, prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
        """See `Loss`."""
        error = squared_error(prediction, batch).mean()
        residual = residual_norm(prediction, batch, physics).mean()
        self.terms = {"mse": error, "residual": residual}
        return error + self.weight * residual


def squared_error(prediction: Tensor, batch: Sample) -> Tensor:
    """Return the mean square of (u - v)/L over degrees of freedom, (B,) [-]."""
    return (prediction - batch.displacement).square().mean(dim=(1, 2))


def residual_norm(prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
    """Return ||R_free(u)|| / ||Phi q_max||, (B,) [-].

    Where elements are inverted so far that the law has no stress, the norm is not finite; such
    samples take the largest finite norm of the batch (1 if there is none) and no gradient.
    """
    residual = _residual(prediction, batch, physics)
    sound = residual.isfinite().all(dim=1)
    if not sound.all():  # evaluated again elsewhere: NaN passes through `where` backwards
        elsewhere = torch.where(sound[:, None, None], prediction, batch.displacement)
        residual = _residual(elsewhere, batch, physics)
    norm = residual.norm(dim=1) / physics.largest_force
    largest = norm[sound].detach().max() if sound.any() else torch.ones_like(norm[0])
    return torch.where(sound, norm, largest)


def _residual(prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
    """Return R where free, (B, N D) [-]."""
    if not torch.is_grad_enabled():
        internal = physics.problem.evaluate(prediction).internal
        return torch.where(physics.problem.free, internal - batch.force, 0.0).flatten(1)
    parts = zip(prediction.split(CHUNK), batch.force.split(CHUNK), strict=True)
    return torch.cat([physics.problem.residual(*part) for part in parts]).flatten(1)

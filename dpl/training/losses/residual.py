"""Losses from the residual of equilibrium: L_r^* and L_r^+ of the paper."""

import lightning as L
import torch
from torch import Tensor

from dpl.fem.postprocess import tangent_product
from dpl.scene import Sample
from dpl.training.losses.loss import Loss, LossContext, squared_error
from dpl.training.losses.supervised import _FixedGradient


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

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """See `Loss`."""
        error = squared_error(prediction, batch)
        weight = residual_norm(prediction.detach(), batch, physics)
        weight = weight if self.per_sample else weight.mean()
        self.terms = {"mse": error.mean(), "residual": weight.mean()}
        return (error * weight).mean()

    def skipped_work(self) -> list[str]:
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

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """See `Loss`."""
        error = squared_error(prediction, batch).mean()
        residual = residual_norm(prediction, batch, physics).mean()
        self.terms = {"mse": error, "residual": residual}
        return error + self.weight * residual


def residual_norm(prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
    """Return ||R_free(u)|| / ||Phi q_max||, (B,) [-].

    Its slope K R / ||R|| takes two more evaluations, see `tangent_product`. Where elements are
    inverted so far that the law has no stress, the norm is not finite; such samples take the
    largest finite norm of the batch (1 if there is none) and no gradient.
    """
    problem = physics.problem.at(batch.poisson)
    residual = torch.where(problem.free, problem.evaluate(prediction).internal - batch.force, 0.0)
    length = residual.flatten(1).norm(dim=1)
    norm, sound = length / physics.largest_force, length.isfinite()
    largest = norm[sound].max() if sound.any() else torch.ones_like(norm[0])
    norm = torch.where(sound, norm, largest)
    if not (prediction.requires_grad and torch.is_grad_enabled()):
        return norm
    unit = residual / length.clamp(min=torch.finfo(length.dtype).tiny)[:, None, None]
    slope = tangent_product(problem, prediction.detach(), unit) / physics.largest_force
    slope = torch.where(slope.isfinite() & sound[:, None, None], slope, 0.0)
    return _FixedGradient.apply(prediction, norm, slope)

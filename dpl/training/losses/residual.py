"""Residual-based losses L_r^* and L_r^+.

Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 2.3.
"""

import lightning as L
import torch
from torch import Tensor

from dpl.fem.postprocess import tangent_product
from dpl.scene import Sample
from dpl.system.checks import check_range
from dpl.training.losses.loss import Loss, LossContext, squared_error, with_gradient
from dpl.training.losses.supervised import MSE

MAX_RESIDUALS = 64  # samples whose residual norms are averaged


class LrStar(Loss):
    """L_r^* = error x ||R|| / ||Phi q_max||; the residual norm is a weight without gradient.

    As in the paper, the residual norm is averaged over the batch and scales the gradient of the
    whole batch. With `per_sample` it also weights the samples of a batch relative to each other.
    The error of the paper is the mean squared one. The mean of a large batch is that of at most
    `MAX_RESIDUALS` of its samples.
    """

    saves = ("no backward pass through the residual: it is a constant weight",)
    dtype = torch.float32

    def __init__(
        self, *, error: MSE | None = None, per_sample: bool = False, limit: float | None = None
    ) -> None:
        """Choose the error and the weighting.

        Args:
            error: Error of displacements; None for `MSE()`.
            per_sample: Weight each sample by its own residual norm, not by the mean of the batch.
            limit: Largest residual norm over the median of its batch; larger ones count as that.
                None: no limit. Almost inverted elements have residuals that are thousands of times
                larger than usual, so that a few batches dominate the momentum of an optimiser.
        """
        super().__init__()
        if limit is not None:
            check_range(1, limit=limit)
        self.error, self.per_sample, self.limit = error or MSE(), per_sample, limit

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        error = self.error.errors(prediction, batch)
        stride = 1 if self.per_sample else -(-len(prediction) // MAX_RESIDUALS)
        some = Sample(*(column[::stride] for column in batch))
        weight = residual_norm(prediction.detach()[::stride].double(), some, physics)
        if self.limit is not None:
            weight = weight.clamp(max=self.limit * weight.median())
        weight = weight if self.per_sample else weight.mean()
        self.terms = {"error": error.mean(), "residual": weight.mean()}
        return (error * weight).mean()


class LrPlus(Loss):
    """L_r^+ = MSE + weight ||R|| / ||Phi q_max||, differentiable through the residual.

    Attributes:
        weight: Current factor on the residual [-].
    """

    def __init__(self, *, weight: float = 1.0, warmup_epochs: int = 0) -> None:
        """Choose the factor on the residual.

        Args:
            weight: Final factor on the residual; the paper has 1.
            warmup_epochs: Number of epochs in which the factor rises linearly from zero.
        """
        super().__init__()
        check_range(0, weight=weight, warmup_epochs=warmup_epochs)
        self._final, self._warmup = weight, warmup_epochs
        self.weight = weight if warmup_epochs == 0 else 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Set the weight of the epoch."""
        if self._warmup:
            self.weight = self._final * min(1.0, trainer.current_epoch / self._warmup)

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        error = squared_error(prediction, batch).mean()
        residual = residual_norm(prediction, batch, physics).mean()
        self.terms = {"error": error, "residual": residual}
        return error + self.weight * residual


def residual_norm(prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
    """Return ||R_free(u)|| / ||Phi q_max||, (B,) [-].

    Its gradient K R / ||R|| takes two more evaluations, see `tangent_product`. If elements are
    inverted so far that the law has no stress, the norm is not finite. Such samples get the largest
    finite norm of the batch (1 if there is none) and a zero gradient.
    """
    problem = physics.problem.with_parameters(batch.parameters)
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
    return with_gradient(prediction, norm, slope)

"""Residual-based losses L_r^* and L_r^+.

Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 2.3.
"""

import torch
from torch import Tensor

from dpl.fem.postprocess import tangent_product
from dpl.scene import Sample
from dpl.system.checks import check_range
from dpl.training.losses.loss import MSE, Loss, LossContext, with_gradient

MAX_RESIDUALS = 64  # samples whose residual norms are averaged


class LrStar(Loss):
    """L_r^* = error x ||R|| / ||Phi q_max||; the residual norm is a weight without gradient.

    As in the paper, the residual norm is averaged over the batch and scales the gradient of the
    whole batch. The error of the paper is the mean squared one. The mean residual norm of a large
    batch is that of at most `MAX_RESIDUALS` of its samples.
    """

    saves = ("no backward pass through the residual: it is a constant weight",)
    dtype = torch.float32

    def __init__(self, *, error: MSE | None = None, limit: float | None = None) -> None:
        """Choose the error and the weighting.

        Args:
            error: Error of displacements; None for `MSE()`.
            limit: Largest residual norm over the median of its batch; larger ones count as that.
                None: no limit. Almost inverted elements have residuals that are thousands of times
                larger than usual, so that a few batches dominate the momentum of an optimiser.
        """
        super().__init__()
        if limit is not None:
            check_range(1, limit=limit)
        self.error, self.limit = error or MSE(), limit

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        error = self.error(prediction, batch, physics)
        stride = -(-len(prediction) // MAX_RESIDUALS)
        some = Sample(*(column[::stride] for column in batch))
        weight = residual_norm(prediction.detach()[::stride].double(), some, physics)
        if self.limit is not None:
            weight = weight.clamp(max=self.limit * weight.median())
        self.terms = {"error": error, "residual": weight.mean()}
        return error * weight.mean()


class LrPlus(Loss):
    """L_r^+ = MSE + weight ||R|| / ||Phi q_max||, differentiable through the residual."""

    def __init__(self, *, weight: float = 1.0) -> None:
        """Choose the factor on the residual; the paper has 1.

        `BlendedLoss` from `MSE` to this loss is the same with a factor that rises from zero.
        """
        super().__init__()
        check_range(0, weight=weight)
        self.error, self.weight = MSE(), weight

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        error = self.error(prediction, batch, physics)
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

"""Supervised losses: squared errors of displacements."""

import torch
from torch import Tensor

from dpl.scene import Sample
from dpl.system.checks import check_range
from dpl.training.losses.loss import Loss, LossContext, clamp_scale, squared_error

SMALLEST_SQUARE = 1e-24  # added to squared errors: the root has no gradient at zero [-]


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
        error = squared_error(prediction, batch)
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

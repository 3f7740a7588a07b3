"""Physics losses: callables (prediction, batch, physics) -> scalar, Lightning callbacks too.

The module carries its loss into the trainer (`configure_callbacks`), so that a loss may anneal
between epochs and log its own terms. Where mechanics enters, slopes come from the compiled forces
of `Problem.evaluate` and not from automatic differentiation, which takes 3 to 17 times as long.

Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 2.3, for the first three.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dpl.scene import Sample
from dpl.training.losses.loss import Loss, LossContext, _checked, clamp_scale, squared_error

SMALLEST_SQUARE = 1e-24  # square of an error below which a norm has no slope [-]


class MSE(Loss):
    """Mean squared error of u/L over all degrees of freedom."""

    def __init__(self, *, relative: float = 0.0, floor: float = 1e-2) -> None:
        """Choose the weighting.

        Args:
            relative: Power of the mean square of its own displacement that each sample's error is
                divided by: at 1 small loads count as much as large ones, at 0 by their size.
            floor: See `clamp_scale`; only where `relative` is above 0.

        Raises:
            ValueError: A number is out of range.
        """
        super().__init__()
        if not 0 <= relative <= 1:
            raise ValueError(f"relative = {relative} must lie between 0 and 1")
        self.relative, self.floor = relative, _checked(floor)

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """See `Loss`."""
        size = batch.displacement.square().mean(dim=(1, 2))
        return self.from_squared_errors(squared_error(prediction, batch), size)

    def from_squared_errors(self, error: Tensor, size: Tensor) -> Tensor:
        """Return the loss of mean squared errors (B,) of displacements of mean squares (B,)."""
        return self._weighted(error, size).mean()

    def _weighted(self, error: Tensor, size: Tensor) -> Tensor:
        return error / clamp_scale(size, self.floor) ** self.relative if self.relative else error

    def skipped_work(self) -> list[str]:
        """See `Loss`."""
        return ["no finite-element evaluation in training: the loss knows no residual"]


class RMSELoss(MSE):
    """Mean over samples of the root mean square error of u/L: e_mean, but for a factor.

    Its slope does not fade as the error falls, and no sample with a large error outweighs a batch.
    """

    def from_squared_errors(self, error: Tensor, size: Tensor) -> Tensor:
        """See `MSE`."""
        return (self._weighted(error, size) + SMALLEST_SQUARE).sqrt().mean()


class _FixedGradient(torch.autograd.Function):
    """Values (B,) of displacements (B, N, D), their slope (B, N, D) found by other means."""

    @staticmethod
    def forward(ctx: Any, displacement: Tensor, value: Tensor, slope: Tensor) -> Tensor:
        ctx.save_for_backward(slope)
        return value.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (slope,) = ctx.saved_tensors
        return gradient[:, None, None] * slope, None, None

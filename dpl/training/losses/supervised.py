"""Supervised losses: squared errors of displacements."""

from typing import Protocol, runtime_checkable

from torch import Tensor

from dpl.scene import Sample
from dpl.system.checks import check_range
from dpl.training.losses.loss import Loss, LossContext, clamp_scale, squared_error

SMALLEST_SQUARE = 1e-24  # added to squared errors: the root has no gradient at zero [-]


@runtime_checkable
class SquaredErrorLoss(Protocol):
    """Loss of squared errors, on which a `TrainsInCoordinates` network trains without fields."""

    def from_squared_errors(self, error: Tensor, size: Tensor) -> Tensor:
        """Return the loss () of mean squared errors (B,) and mean squared displacements (B,)."""
        ...


class MSE(Loss):
    """Mean squared error of u/L over all degrees of freedom."""

    saves = ("no finite-element evaluation in training: the loss has no residual term",)

    def __init__(self, *, relative: float = 0.0, floor: float = 1e-2) -> None:
        """Choose the weighting.

        Args:
            relative: Exponent of the mean squared displacement by which the error of each sample is
                divided. 1 gives relative errors, 0 absolute errors.
            floor: See `clamp_scale`; has no effect if `relative` is 0.

        Raises:
            ValueError: A number is out of range.
        """
        super().__init__()
        check_range(0, 1, relative=relative, floor=floor)
        self.relative, self.floor = relative, floor

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """See `Loss`."""
        size = batch.displacement.square().mean(dim=(1, 2))
        return self.from_squared_errors(squared_error(prediction, batch), size)

    def from_squared_errors(self, error: Tensor, size: Tensor) -> Tensor:
        """See `SquaredErrorLoss`."""
        return self._weighted(error, size).mean()

    def _weighted(self, error: Tensor, size: Tensor) -> Tensor:
        return error / clamp_scale(size, self.floor) ** self.relative if self.relative else error


class RMSELoss(MSE):
    """Mean over samples of the root mean square error of u/L: e_mean times the root of N.

    Its gradient does not vanish with the error, and samples with large errors dominate a batch less
    than in the mean squared error.
    """

    def from_squared_errors(self, error: Tensor, size: Tensor) -> Tensor:
        """See `SquaredErrorLoss`."""
        return (self._weighted(error, size) + SMALLEST_SQUARE).sqrt().mean()

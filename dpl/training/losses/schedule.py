"""A loss that blends from one loss to another during training."""

import lightning as L
from torch import Tensor

from dpl.scene import Sample
from dpl.training.losses.loss import Loss, LossContext


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

        Raises:
            ValueError: A number is out of range.
        """
        super().__init__()
        if epochs < 1 or start < 0:
            raise ValueError(f"epochs = {epochs} must be 1 or more, start = {start} 0 or more")
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

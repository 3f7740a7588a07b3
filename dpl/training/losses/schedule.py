"""A loss that turns into another one during training."""

import lightning as L
from torch import Tensor

from dpl.scene import Sample
from dpl.training.losses.loss import Loss, LossContext


class BlendedLoss(Loss):
    """One loss that turns into another: (1 - weight) first + weight second.

    Attributes:
        weight: Part of the second loss at present [-].
    """

    def __init__(self, first: Loss, second: Loss, *, epochs: int, start: int = 0) -> None:
        """Choose from what to what, and when.

        Args:
            first: The loss up to `start`.
            second: The loss from `start + epochs` on; best of the same size as the first one.
            epochs: Epochs in which the weight rises linearly from 0 to 1.
            start: Epoch in which it begins to.

        Raises:
            ValueError: A number is out of range.
        """
        super().__init__()
        if epochs < 1 or start < 0:
            raise ValueError(f"epochs = {epochs} must be 1 or more, start = {start} 0 or more")
        self.first, self.second = first, second
        self._epochs, self._start = epochs, start
        self.weight = 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Anneal the weight, and those of the parts."""
        passed = (trainer.current_epoch - self._start) / self._epochs
        self.weight = min(1.0, max(0.0, passed))
        for loss in (self.first, self.second):
            loss.on_train_epoch_start(trainer, module)

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """See `Loss`; a part of weight 0 is not evaluated."""
        total = prediction.new_zeros(())
        self.terms = {"weight": total + self.weight}
        parts = {"first": (1 - self.weight, self.first), "second": (self.weight, self.second)}
        for name, (share, loss) in parts.items():
            if share > 0:
                value = loss(prediction, batch, physics)
                total = total + share * value
                self.terms |= {name: value}
                self.terms |= {f"{name}/{term}": what for term, what in loss.terms.items()}
        return total

    def skipped_work(self) -> list[str]:
        """Return what both leave out."""
        return [line for line in self.first.skipped_work() if line in self.second.skipped_work()]

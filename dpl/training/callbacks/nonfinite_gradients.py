"""Steps that are not finite: skipped, counted, and the end of a training that has no others."""

import sys
from typing import Any

import lightning as L
import torch


class Diverged(ArithmeticError):
    """A training that has no finite gradients any more, and what to do about it."""


class SkipNonFiniteGradients(L.Callback):
    """Skips the steps whose gradients are not finite, and ends a training that has no others.

    A sample, a loss or a slope that is infinite or not a number shows in the gradients; a step with
    them would be the end of all weights. Such a step is left out (momenta and weights stay as they
    are) and counted under `skipped`, and the count is kept in checkpoints.

    Attributes:
        patience: Skipped steps one after the other that end the training.
        skipped: All of them so far.
    """

    def __init__(self, *, patience: int = 20) -> None:
        """Choose when to give up.

        Raises:
            ValueError: `patience` is less than 1.
        """
        if patience < 1:
            raise ValueError(f"patience = {patience} must be 1 or more")
        self.patience, self.skipped, self._running = patience, 0, 0

    def on_before_optimizer_step(
        self, trainer: L.Trainer, pl_module: L.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        """Take the gradients away if one of them is not finite.

        Raises:
            Diverged: So many steps in a row had such gradients.
        """
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        norm = torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
        if norm.isfinite():
            self._running = 0
            return
        for parameter in parameters:
            parameter.grad = None
        where = f"epoch {trainer.current_epoch}, step {trainer.global_step}"
        if not self._running:
            print(f"{where}: gradients are not finite; the step is skipped", file=sys.stderr)
        self.skipped, self._running = self.skipped + 1, self._running + 1
        pl_module.log("skipped", float(self.skipped))
        if self._running >= self.patience:
            rates = {group["lr"] for group in optimizer.param_groups}
            raise Diverged(
                f"training has diverged: {self._running} steps in a row, up to {where}, had no "
                f"finite gradients, at a learning rate of {max(rates):.1e}; lower optimizer.lr "
                "(the best checkpoint so far, if there is one, is whole)"
            )

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Say how many steps were skipped, and if what was learnt is worth nothing."""
        if not trainer.is_global_zero:
            return
        if self.skipped:
            print(f"{self.skipped} steps were skipped: gradients not finite", file=sys.stderr)
        error = trainer.callback_metrics.get("val/rel_L2_median")
        if error is not None and not error < 1:
            print(
                f"the network is no better than no answer at all: its median relative error is "
                f"{float(error):.1e}; a lower optimizer.lr or longer training may help",
                file=sys.stderr,
            )

    def state_dict(self) -> dict[str, Any]:
        """Return the count."""
        return {"skipped": self.skipped}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on counting."""
        self.skipped = int(state_dict["skipped"])

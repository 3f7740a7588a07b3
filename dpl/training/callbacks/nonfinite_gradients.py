"""Skip and count optimiser steps with non-finite gradients; stop a training that diverged."""

import sys
from typing import Any

import lightning as L
import torch

from dpl.system.checks import check_range


class Diverged(ArithmeticError):
    """Raised when the gradients of many consecutive steps are not finite."""


class SkipNonFiniteGradients(L.Callback):
    """Skips optimiser steps with non-finite gradients and stops a training that diverged.

    Every infinite or NaN sample, loss or gradient makes the gradient norm non-finite, and a step
    with it would make all weights NaN. The number of skipped steps is logged as `skipped_steps`.
    """

    def __init__(self, *, patience: int = 20) -> None:
        """Choose the number of consecutive skipped steps that stops the training."""
        check_range(1, patience=patience)
        self.patience, self.skipped_steps, self._consecutive = patience, 0, 0

    def on_before_optimizer_step(
        self, trainer: L.Trainer, pl_module: L.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        """Remove the gradients, which skips the step, if one of them is not finite.

        Raises:
            Diverged: `patience` consecutive steps had non-finite gradients.
        """
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        norm = torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
        if norm.isfinite():
            self._consecutive = 0
            return
        for parameter in parameters:
            parameter.grad = None
        where = f"epoch {trainer.current_epoch}, step {trainer.global_step}"
        if not self._consecutive:
            print(f"{where}: gradients are not finite; the step is skipped", file=sys.stderr)
        self.skipped_steps += 1
        self._consecutive += 1
        pl_module.log("skipped_steps", float(self.skipped_steps))
        if self._consecutive >= self.patience:
            rates = {group["lr"] for group in optimizer.param_groups}
            raise Diverged(
                f"training has diverged: the gradients of {self._consecutive} consecutive steps up "
                f"to {where} were not finite at a learning rate of {max(rates):.1e}; reduce "
                "optimizer.lr (an existing best checkpoint is still valid)"
            )

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Print the number of skipped steps, and a warning if the median error is 100 % or more."""
        if not trainer.is_global_zero:
            return
        if self.skipped_steps:
            print(f"{self.skipped_steps} steps were skipped: gradients not finite", file=sys.stderr)
        error = trainer.callback_metrics.get("val/rel_L2_median")
        if error is not None and not error < 1:
            print(
                f"the network is no better than a prediction of zero: its median relative error is "
                f"{float(error):.1e}; reduce optimizer.lr or train for more epochs",
                file=sys.stderr,
            )

    def state_dict(self) -> dict[str, Any]:
        """Return the number of skipped steps."""
        return {"skipped_steps": self.skipped_steps}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the number of skipped steps."""
        self.skipped_steps = int(state_dict["skipped_steps"])

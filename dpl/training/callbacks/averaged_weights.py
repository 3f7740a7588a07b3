"""Exponential moving average of the weights of a training."""

from typing import Any

import lightning as L
import torch
from torch import Tensor, nn

RISE = 10  # the decay of step n is (1 + n) / (RISE + n) at most


class AveragedWeights(L.Callback):
    """Validates and stores an exponential moving average of the weights instead of the weights.

    After each optimiser step the average moves towards the weights: average = d average + (1 - d)
    weights. After n steps d is the smaller one of `decay` and (1 + n) / (10 + n), so that the
    weights of the beginning are soon forgotten. Validations, pictures and stored weights are those
    of the average. The training continues with the weights, which `last.ckpt` contains in addition.

    Lightning's `EMAWeightAveraging` cannot be used: it copies the whole module with its scene,
    averages integer buffers, and does not act on checkpoints that contain only weights.

    Source: Polyak, Juditsky (1992), SIAM J. Control Optim. 30; the rising decay is that of
    TensorFlow's ExponentialMovingAverage.
    """

    def __init__(self, *, decay: float = 0.999) -> None:
        """Choose the decay."""
        if not 0 <= decay < 1:
            raise ValueError(f"decay = {decay} must be 0 or more and less than 1")
        self.decay, self.steps = decay, 0
        self.average: dict[str, Tensor] = {}  # by the names of the weights
        self._weights: dict[str, nn.Parameter] = {}
        self._restored: dict[str, Tensor] = {}  # weights of a resumed run
        self._last_step = 0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the average at the weights; the weights of a resumed run are restored."""
        self._weights = dict(pl_module.named_parameters())
        self.average = {name: w.detach().clone() for name, w in self._weights.items()}
        with torch.no_grad():
            for name, weight in self._restored.items():
                self._weights[name].copy_(weight)
        self._restored = {}
        self._last_step = trainer.global_step

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any, **kwargs: Any
    ) -> None:
        """Update the average if the optimiser has made a step."""
        if trainer.global_step == self._last_step:
            return
        self._last_step = trainer.global_step
        self.steps += 1
        decay = min(self.decay, (1 + self.steps) / (RISE + self.steps))
        with torch.no_grad():
            for name, weight in self._weights.items():
                self.average[name].lerp_(weight, 1 - decay)

    @torch.no_grad()
    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Exchange the average and the weights of the module, before and after a validation."""
        for name, average in self.average.items():
            weight = self._weights[name].clone()
            self._weights[name].copy_(average)
            average.copy_(weight)

    on_validation_end = on_validation_start

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Leave the average in the module."""
        self.on_validation_start(trainer, pl_module)
        self.average, self._weights = {}, {}

    def state_dict(self) -> dict[str, Any]:
        """Return the number of steps and the weights without averaging."""
        weights = {name: weight.detach() for name, weight in self._weights.items()}
        return {"steps": self.steps, "weights": weights}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the number of steps and, at the start of the training, the weights."""
        self.steps, self._restored = int(state_dict["steps"]), dict(state_dict["weights"])

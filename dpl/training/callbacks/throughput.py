"""Log how many samples per second a training sees, and how much memory it holds."""

import os
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch import Tensor

from dpl.data import OnlineData


class ThroughputMonitor(L.Callback):
    """Logs how fast samples are made and used, once an epoch, validation left out.

    `rate/steps` and `rate/consumed` (samples) a second; of a stream besides `rate/produced`
    (samples a second), `online/waiting` (part of the time in which the optimiser had nothing to
    do), `online/uses` (of a sample, on average) and `online/buffer` (samples). `memory/process`
    and, on a GPU, the most that was taken of it, `memory/gpu` [GB].
    """

    def __init__(self) -> None:
        """Start with nothing counted."""
        self._steps = self._samples = 0
        self._seconds = self._mark = 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start counting."""
        self._steps, self._samples, self._seconds = trainer.global_step, 0, 0.0
        self._mark = time.perf_counter()

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Sequence[Tensor],
        batch_idx: int,
    ) -> None:
        """Count a batch and its time."""
        now = time.perf_counter()
        self._seconds, self._mark = self._seconds + now - self._mark, now
        self._samples += len(batch[0])

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Leave its time out."""
        self._mark = time.perf_counter()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log the epoch; of several processes the sums."""
        seconds = max(self._seconds, 1e-9)
        sums = {"rate/consumed": self._samples / seconds, "memory/process": resident_memory()}
        means = {"rate/steps": (trainer.global_step - self._steps) / seconds}
        data = getattr(trainer, "datamodule", None)
        if isinstance(data, OnlineData) and (rates := data.rates) is not None:
            sums |= {"rate/produced": rates.produced, "online/buffer": float(rates.buffer)}
            means |= {"online/waiting": rates.waiting, "online/uses": rates.uses}
        if pl_module.device.type == "cuda":
            sums["memory/gpu"] = torch.cuda.max_memory_allocated(pl_module.device) / 1e9
        pl_module.log_dict(sums, sync_dist=True, reduce_fx="sum")
        pl_module.log_dict(means, sync_dist=True)


def resident_memory() -> float:
    """Return the memory that this process holds [GB]; zero where the system does not say."""
    with suppress(OSError):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e9
    return 0.0

"""Record the wall time of a training."""

import time
from pathlib import Path
from typing import Any

import lightning as L
import torch

from dpl.system.files import append_jsonl


class TrainingTime(L.Callback):
    """Appends a line to `training.jsonl` at the end of each session of a training.

    The line holds the wall time with bases and validations but without data generation
    [s], the number of optimiser steps, the number of threads and the device.
    """

    def __init__(self, *, folder: str | Path) -> None:
        """Choose the folder of the run."""
        self.path = Path(folder) / "training.jsonl"
        self._start = 0.0

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Start the clock."""
        self._start = time.perf_counter()

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Write the line, also that of an interrupted session."""
        if trainer.is_global_zero and self._start:
            line = {
                "seconds": round(time.perf_counter() - self._start, 3),
                "steps": trainer.global_step,
                "threads": torch.get_num_threads(),
                "device": str(trainer.strategy.root_device),  # the module may have left it
            }
            append_jsonl(self.path, line)
            self._start = 0.0

    on_exception = on_fit_end

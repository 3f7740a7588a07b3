"""Keep the training time of a run in its checkpoints."""

import time
from pathlib import Path

import lightning as L
import torch

from dpl.system.files import append_jsonl


class TrainingTime(L.Callback):
    """Writes how long a training took, bases and validations included, the data set not.

    A line of `training.jsonl` for each session: seconds, steps at its end, threads, device.
    """

    def __init__(self, *, folder: str | Path) -> None:
        """Choose where to write: the folder of the run."""
        self.path, self._start = Path(folder) / "training.jsonl", 0.0

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Start the clock."""
        self._start = time.perf_counter()

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Write the line."""
        self._write(trainer, pl_module)

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Write the line of a session that was interrupted."""
        self._write(trainer, pl_module)

    def _write(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        if trainer.is_global_zero and self._start:
            line = {
                "seconds": round(time.perf_counter() - self._start, 3),
                "steps": trainer.global_step,
                "threads": torch.get_num_threads(),
                "device": str(module.device),
            }
            append_jsonl(self.path, line)
            self._start = 0.0

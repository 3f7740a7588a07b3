"""Log the samples per second and the memory of a training, and record its duration."""

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import lightning as L
import torch

from dpl.data import DataModule
from dpl.system.files import append_jsonl


class ThroughputMonitor(L.Callback):
    """Logs throughput and memory [GB] once per epoch; the time of validation does not count.

    docs/monitoring.md describes each tag.
    """

    def __init__(self) -> None:
        """Start with zero counts."""
        self._steps = self._samples = 0
        self._seconds = self._mark = 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Reset the counts."""
        self._steps, self._samples, self._seconds = trainer.global_step, 0, 0.0
        self._mark = time.perf_counter()

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, *_: Any
    ) -> None:
        """Add the samples and the time of a batch."""
        now = time.perf_counter()
        self._seconds, self._mark = self._seconds + now - self._mark, now
        self._samples += len(batch[0])

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Restart the clock after a validation."""
        self._mark = time.perf_counter()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log throughput and memory; rates of samples and memory are sums over processes."""
        seconds = max(self._seconds, 1e-9)
        sums = {"rate/consumed": self._samples / seconds, "memory/process": resident_memory()}
        means = {"rate/steps": (trainer.global_step - self._steps) / seconds}
        data = getattr(trainer, "datamodule", None)
        if isinstance(data, DataModule) and (rates := data.source.rates) is not None:
            sums |= {"rate/produced": rates["produced"], "online/buffer": rates["buffer"]}
            means |= {f"online/{name}": rates[name] for name in ("waiting", "uses")}
        if pl_module.device.type == "cuda":
            sums["memory/gpu"] = torch.cuda.max_memory_allocated(pl_module.device) / 1e9
        pl_module.log_dict(sums, sync_dist=True, reduce_fx="sum")
        pl_module.log_dict(means, sync_dist=True)


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


def resident_memory() -> float:
    """Return the resident memory of this process [GB]; 0 where /proc is not available."""
    with suppress(OSError):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e9
    return 0.0

"""Training of a model in closed form: a fit for each number of loads of its data set."""

import math
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import lightning as L
import torch

from dpl.data.datamodule import DataModule
from dpl.models.protocols import ClosedFormFit
from dpl.training import checkpoints
from dpl.training.callbacks.tensorboard import LogHyperparameters
from dpl.training.callbacks.throughput import resident_memory
from dpl.training.callbacks.training_time import TrainingTime
from dpl.training.callbacks.worst_cases import WorstCasePlots
from dpl.training.surrogate import Surrogate

# metrics of a learning curve, by their names there
METRICS = {"median": "rel_L2_median", "worst": "rel_L2_worst", "e_mean": "e_mean"}
OBSERVERS = (LogHyperparameters, TrainingTime, WorstCasePlots)


def fit(
    surrogate: Surrogate,
    data: DataModule,
    *,
    trainer: L.Trainer | None = None,
    folder: Path | None = None,
) -> float:
    """Fit the network of a surrogate to the training samples, on the CPU.

    `Stored` samples are fitted once. A source that is `Growing` repeats the fit with more loads.
    After each fit its errors on the validation samples are printed, logged, and written with the
    weights.

    Args:
        surrogate: The surrogate; its network is a `ClosedFormFit`.
        data: The data module; missing loads are solved.
        trainer: Its loggers take the errors, and its callbacks of the kinds `OBSERVERS` observe the
            fits. Its other parts have no effect.
        folder: Folder of the run, for checkpoints that `dpl.load` reads; None: none are written.

    Returns:
        The smallest `MeanError` of the fits on the validation samples [-]; infinite if no error is
        finite.

    Raises:
        DataSetError: The folder of the data holds something else, or another process writes there.
        KeyboardInterrupt: The training was interrupted; solved loads and checkpoints are kept.
        SystemExit: After SIGTERM, with status 143.
    """
    net, loggers = cast(ClosedFormFit, surrogate.cpu().net), trainer.loggers if trainer else []
    done = [point.e_mean for point in data.source.points]
    best, first = min(filter(math.isfinite, done), default=math.inf), len(done)
    fits = 0
    try:
        with _exit_on_sigterm():
            for fits, sizes in enumerate(data.source.fits(data.dataset), 1):
                if fits == 1:
                    _call_observers(trainer, surrogate, data, "setup", "fit")
                    _call_observers(trainer, surrogate, data, "on_train_start")
                    _call_observers(trainer, surrogate, data, "on_train_epoch_start")
                data.sizes |= sizes
                net.fit(data.samples("train"), data.samples("val"))
                errors = validation_errors(surrogate, data)
                curve = {name: errors[f"val/{metric}"] for name, metric in METRICS.items()}
                print(data.source.record(sizes["train"], curve), flush=True)
                for logger in loggers:
                    numbers = {"epoch": first + fits - 1, "memory/process": resident_memory()}
                    logger.log_metrics({**errors, **numbers}, step=first + fits - 1)
                    numbers = {f"learning_curve/{m}": errors[f"val/{m}"] for m in METRICS.values()}
                    logger.log_metrics(numbers, step=sizes["train"])
                    logger.save()
                if improved := curve["e_mean"] < best:
                    best = curve["e_mean"]
                if folder is not None:
                    _write(surrogate, data, folder / "checkpoints", improved=improved)
                _call_observers(trainer, surrogate, data, "on_validation_epoch_end")
        if fits:
            _call_observers(trainer, surrogate, data, "on_train_end")
    finally:
        data.source.close()
        _call_observers(trainer, surrogate, data, "on_fit_end")
        for logger in loggers:
            logger.finalize("finished")
    return best


def validation_errors(surrogate: Surrogate, data: DataModule) -> dict[str, float]:
    """Return the metrics `val/NAME` and the mean loss `loss/val` on the validation samples."""
    metrics, loss, count = surrogate.eval().val_metrics, 0.0, 0
    metrics.reset()
    with torch.no_grad():
        for batch in data.val_dataloader():
            prediction, size = surrogate.predict(batch.load), len(batch.force)
            metrics.update(prediction, batch)
            loss += size * float(surrogate.loss(prediction, batch, surrogate.physics))
            count += size
    found = {name: float(value) for name, value in metrics.compute().items()}
    return {**found, "loss/val": loss / count}


def _write(surrogate: Surrogate, data: DataModule, folder: Path, *, improved: bool) -> None:
    """Write the checkpoint from which a run is resumed, and the best weights if they improved."""
    checkpoint: dict[str, Any] = {
        **{key: {} for key in checkpoints.RESUME_KEYS},  # a fit has no state of an optimiser
        "state_dict": surrogate.state_dict(),
        "epoch": 0,
        "global_step": 0,
        checkpoints.DATA: data.state_dict(),
    }
    surrogate.on_save_checkpoint(checkpoint)
    if improved:
        checkpoints.write(checkpoint, folder / f"best{checkpoints.WEIGHTS}")
    checkpoints.write(checkpoint, folder / "last.ckpt")


def _call_observers(
    trainer: L.Trainer | None, surrogate: Surrogate, data: DataModule, hook: str, *more: Any
) -> None:
    """Call a hook of Lightning of the callbacks that observe fits."""
    if trainer is None:
        return
    trainer.datamodule = data  # its validation samples are drawn
    for one in trainer.callbacks:
        if isinstance(one, OBSERVERS):
            getattr(one, hook)(trainer, surrogate, *more)


@contextmanager
def _exit_on_sigterm() -> Iterator[None]:
    """Let SIGTERM raise SystemExit with status 143, in the main thread of a process only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)

"""Training of a model in closed form: a fit for each number of loads of its data set."""

import math
import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import lightning as L
import torch

from dpl.data.datamodule import DataModule
from dpl.models.interface import ClosedFormFit
from dpl.scene import Sample
from dpl.training import checkpoints
from dpl.training.callbacks.tensorboard import LogHyperparameters
from dpl.training.callbacks.throughput import TrainingTime, resident_memory
from dpl.training.callbacks.worst_cases import WorstCasePlots
from dpl.training.metrics import ErrorMetrics
from dpl.training.surrogate import Surrogate

# metrics of a learning curve, by their names there
OF_CURVE = {"median": "rel_L2_median", "worst": "rel_L2_worst", "e_mean": "e_mean"}
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
    After each fit its errors on the validation samples are logged, and written with the weights.

    Args:
        surrogate: The surrogate; its network is a `ClosedFormFit`.
        data: The data module; missing loads are solved.
        trainer: Its loggers take the errors, and its callbacks of the kinds `OBSERVERS` observe the
            fits. Its other parts have no effect.
        folder: Folder of the run, for checkpoints that `dpl.load` reads; None: none are written.

    Returns:
        The smallest e_mean of the fits on the validation samples [-]; infinite if no error is
        finite. After an interruption solved loads and checkpoints are kept; SIGTERM raises
        SystemExit with status 143.
    """
    net = cast(ClosedFormFit, surrogate.cpu().net)
    loggers, callbacks = (trainer.loggers, trainer.callbacks) if trainer else ([], [])
    if trainer is not None:
        trainer.datamodule = data  # whose validation samples are drawn

    def call(hook: str, *more: Any) -> None:
        for one in callbacks:
            if isinstance(one, OBSERVERS):
                getattr(one, hook)(trainer, surrogate, *more)

    done = [point.e_mean for point in data.source.points]
    best, first, step = min(filter(math.isfinite, done), default=math.inf), len(done), None
    try:
        with _exit_on_sigterm():
            for step, sizes in enumerate(data.source.fits(data.dataset), first):
                if step == first:
                    call("setup", "fit")
                    call("on_train_start")
                    call("on_train_epoch_start")
                data.sizes |= sizes
                net.fit(data.samples("train"), data.samples("val"))
                errors = found = errors_on(surrogate, data.val_dataloader())
                if (unseen := data.source.unseen(data.store, sizes["train"])) is not None:
                    found = errors_on(surrogate, [unseen])
                curve = {name: found[f"val/{metric}"] for name, metric in OF_CURVE.items()}
                print(data.source.record(sizes["train"], curve), flush=True)
                numbers = {**errors, "epoch": step, "memory/process": resident_memory()}
                points = {f"learning_curve/{m}": found[f"val/{m}"] for m in OF_CURVE.values()}
                for logger in loggers:
                    logger.log_metrics(numbers, step=step)
                    logger.log_metrics(points, step=sizes["train"])
                    logger.save()
                improved, best = errors["val/e_mean"] < best, min(best, errors["val/e_mean"])
                if folder is not None:
                    _write(surrogate, data, folder / "checkpoints", improved=improved)
                call("on_validation_epoch_end")
        if step is not None:
            call("on_train_end")
    finally:
        data.source.close()
        call("on_fit_end")
        for logger in loggers:
            logger.finalize("finished")
    return best


def errors_on(surrogate: Surrogate, batches: Iterable[Sample]) -> dict[str, float]:
    """Return the metrics `val/NAME` and the mean loss `loss/val` on samples."""
    metrics, loss, count = ErrorMetrics(surrogate.scene.problem), 0.0, 0
    surrogate.eval()
    with torch.no_grad():
        for batch in batches:
            prediction, size = surrogate.predict(batch.load), len(batch.force)
            metrics.update(prediction, batch)
            loss += size * float(surrogate.loss(prediction, batch, surrogate.physics))
            count += size
    found = {f"val/{name}": float(value) for name, value in metrics.compute().items()}
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

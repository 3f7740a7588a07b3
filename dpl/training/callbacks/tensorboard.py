"""Write the hyperparameters and the learning rate of a run for TensorBoard."""

import time
from collections.abc import Mapping
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import LearningRateMonitor
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils.tensorboard import SummaryWriter

from dpl.training.callbacks.nonfinite_gradients import Diverged


class LogLearningRate(LearningRateMonitor):
    """Lightning's callback, without its error where the trainer has no logger."""

    def on_train_start(self, trainer: L.Trainer, *args: Any, **kwargs: Any) -> None:
        """Find the optimisers; leave the callbacks if there is no logger."""
        if trainer.loggers:
            super().on_train_start(trainer, *args, **kwargs)
        else:  # a new list, since the trainer is looping over this one
            trainer.callbacks = [one for one in trainer.callbacks if one is not self]


class LogHyperparameters(L.Callback):
    """Logs the hyperparameters of a run, its state and its final errors.

    TensorBoard's HPARAMS tab lists a run from its first step on. An interrupted run keeps the state
    "running", a diverged run has failed, an evaluated run (`finish`) has succeeded. A resumed run
    continues the same curves.
    """

    def __init__(self, hyperparameters: Mapping[str, bool | int | float | str]) -> None:
        """Take a flat mapping of names to hyperparameters."""
        self.hyperparameters = dict(hyperparameters)
        self.begun = False  # True after an epoch has begun in this session

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Record that the checkpoint of a resumed run has been restored."""
        self.begun = True

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log the hyperparameters and the start of the session."""
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog
        from torch.utils.tensorboard.summary import hparams

        if not trainer.is_global_zero:
            return
        for logger in trainer.loggers:
            if not isinstance(logger, TensorBoardLogger):
                logger.log_hyperparams(self.hyperparameters)
        # without the list of columns that Lightning would write: it hides columns of other runs
        _, start, _ = hparams(self.hyperparameters, {})
        # at the second start of a session readers drop events of later steps
        session = Event(session_log=SessionLog(status=SessionLog.START))
        for writer in tensorboard_writers(trainer):
            events = writer._get_file_writer()
            events.add_event(session, trainer.global_step)
            events.add_summary(start)

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Log the failure of a diverged training; other exceptions leave the run resumable."""
        if isinstance(exception, Diverged):
            _log_end(trainer, failed=True)

    def finish(self, trainer: L.Trainer, errors: Mapping[str, float]) -> None:
        """Log the errors of the best weights on the test loads as `best/NAME`."""
        if not trainer.is_global_zero:
            return
        # the HPARAMS tab sorts its columns by name and shows the first ones
        named = {f"best/{name}": value for name, value in errors.items()}
        _log_end(trainer, failed=False)
        for logger in trainer.loggers:
            logger.log_metrics(named, step=last_step(trainer))
            logger.save()
            logger.finalize("success")


def _log_end(trainer: L.Trainer, *, failed: bool) -> None:
    """Write the end of the session for the HPARAMS tab."""
    # torch writes no failures, and tensorboard.plugins.hparams.summary imports TensorFlow
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2

    status = api_pb2.STATUS_FAILURE if failed else api_pb2.STATUS_SUCCESS
    info = plugin_data_pb2.SessionEndInfo(status=status, end_time_secs=time.time())
    data = metadata.create_summary_metadata(
        plugin_data_pb2.HParamsPluginData(session_end_info=info)
    )
    end = Summary(value=[Summary.Value(tag=metadata.SESSION_END_INFO_TAG, metadata=data)])
    for writer in tensorboard_writers(trainer):
        writer._get_file_writer().add_summary(end)


def tensorboard_writers(trainer: L.Trainer) -> list[SummaryWriter]:
    """Return the TensorBoard writers of a trainer; none in any process but the first."""
    loggers = trainer.loggers if trainer.is_global_zero else []
    return [logger.experiment for logger in loggers if isinstance(logger, TensorBoardLogger)]


def last_step(trainer: L.Trainer) -> int:
    """Return the number under which Lightning logs the scalars of the last optimiser step."""
    return max(0, trainer.global_step - 1)

"""Write the hyperparameters and the learning rate of a run for TensorBoard."""

import time
from collections.abc import Mapping
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import LearningRateMonitor
from lightning.pytorch.loggers import TensorBoardLogger

from dpl.training.callbacks.nonfinite_gradients import Diverged
from dpl.training.callbacks.worst_cases import _boards, _step


class LogLearningRate(LearningRateMonitor):
    """Lightning's callback, which would end a training that has no logger."""

    def on_train_start(self, trainer: L.Trainer, *args: Any, **kwargs: Any) -> None:
        """Find the optimisers, if there is a logger."""
        if trainer.loggers:
            super().on_train_start(trainer, *args, **kwargs)

    def on_train_batch_start(self, trainer: L.Trainer, *args: Any, **kwargs: Any) -> None:
        """Log the rate, if there is a logger."""
        if trainer.loggers:
            super().on_train_batch_start(trainer, *args, **kwargs)

    def on_train_epoch_start(self, trainer: L.Trainer, *args: Any, **kwargs: Any) -> None:
        """Log the rate, if there is a logger."""
        if trainer.loggers:
            super().on_train_epoch_start(trainer, *args, **kwargs)


class LogHyperparameters(L.Callback):
    """Tells loggers what makes this run differ from others, and how it ended.

    TensorBoard's HPARAMS tab shows a run from its first step on, with the last of all its scalars;
    one that was interrupted stays open, one that diverged has failed, one that was judged
    (`finish`) has succeeded. A resumed run goes on in the same curves: what was written beyond the
    checkpoint by the session before is withdrawn.

    Attributes:
        hyperparameters: Flat, numbers, truth values and texts.
        begun: Whether an epoch has begun in this session.
    """

    def __init__(self, hyperparameters: Mapping[str, bool | int | float | str]) -> None:
        """Keep what to tell."""
        self.hyperparameters = dict(hyperparameters)
        self.begun = False

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Remember that what is resumed has been restored."""
        self.begun = True

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Tell what run this is."""
        from torch.utils.tensorboard.summary import hparams

        if not trainer.is_global_zero:
            return
        for logger in trainer.loggers:
            if not isinstance(logger, TensorBoardLogger):
                logger.log_hyperparams(self.hyperparameters)
        # not the list of columns, which Lightning would write: it hides those of other runs
        _, start, _ = hparams(self.hyperparameters, {})
        for board in _boards(trainer):
            writer = board._get_file_writer()
            writer.add_event(_started(), trainer.global_step)  # readers count the second one
            writer.add_summary(start)

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Tell that a training diverged; others can be resumed."""
        if isinstance(exception, Diverged):
            for board in _boards(trainer):
                board._get_file_writer().add_summary(_end(failed=True))

    def finish(self, trainer: L.Trainer, errors: Mapping[str, float]) -> None:
        """Tell the errors of the best weights on the test loads, as `best/NAME`.

        So they come first in the HPARAMS tab, which sorts by name and shows a few.
        """
        if not trainer.is_global_zero:
            return
        named = {f"best/{name}": value for name, value in errors.items()}
        for logger in trainer.loggers:
            logger.log_metrics(named, step=_step(trainer))
        for board in _boards(trainer):
            board._get_file_writer().add_summary(_end(failed=False))
        for logger in trainer.loggers:
            logger.save()
            logger.finalize("success")


def _started() -> Any:
    """Return the event of a session's start: readers drop what they have of later steps."""
    from tensorboard.compat.proto.event_pb2 import Event, SessionLog

    return Event(session_log=SessionLog(status=SessionLog.START))


def _end(*, failed: bool) -> Any:
    """Return the summary that ends a session of the HPARAMS tab."""
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2

    status = api_pb2.STATUS_FAILURE if failed else api_pb2.STATUS_SUCCESS
    info = plugin_data_pb2.SessionEndInfo(status=status, end_time_secs=time.time())
    data = plugin_data_pb2.HParamsPluginData(session_end_info=info)
    described = metadata.create_summary_metadata(data)
    return Summary(value=[Summary.Value(tag=metadata.SESSION_END_INFO_TAG, metadata=described)])

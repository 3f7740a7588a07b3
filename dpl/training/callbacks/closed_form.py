"""Training of a model that is fitted in closed form: one fit in each epoch."""

from typing import cast

import lightning as L
from torch import nn

from dpl.data.datamodule import OfflineData
from dpl.models.protocols import ClosedFormFit

ERRORS = ("rel_L2_median", "rel_L2_worst", "e_mean")


class ClosedFormTraining(L.Callback):
    """Fits the network of a surrogate to all training samples at the begin of each epoch.

    The training ends after the first epoch, or once a growing data set needs no more loads
    (`dpl.data.OfflineData` with `train="auto"`). In that case the held-out errors of each fit are
    printed, and logged as `learning_curve/NAME` with the number of training loads as the step.
    """

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Limit epochs to one batch; log and validate after each one, not before the first."""
        if stage == "fit":
            trainer.num_sanity_val_steps = 0
            trainer.limit_train_batches = trainer.log_every_n_steps = 1
            trainer.check_val_every_n_epoch = 1

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Fit the network, on the CPU: a fit needs factors and compiled loops."""
        data, net = _data(trainer), cast(nn.Module, pl_module.net)
        cast(ClosedFormFit, net.cpu()).fit(data.samples("train"), data.samples("val"))
        net.to(pl_module.device)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Record the held-out errors; end the training if no further fit is needed."""
        data = _data(trainer)
        if data.growth is None:
            trainer.should_stop = True
            return
        loads = data.sizes["train"]
        errors = {name: float(trainer.callback_metrics[f"val/{name}"]) for name in ERRORS}
        print(data.growth.record(loads, errors), flush=True)
        for logger in trainer.loggers:
            logged = {f"learning_curve/{name}": value for name, value in errors.items()}
            logger.log_metrics(logged, step=loads)
        trainer.should_stop = data.growth.is_finished


def _data(trainer: L.Trainer) -> OfflineData:
    return cast(OfflineData, trainer.datamodule)

"""Access to the TensorBoard writers of a trainer."""

from collections.abc import Iterator

import lightning as L
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils.tensorboard import SummaryWriter


def tensorboard_writers(trainer: L.Trainer) -> Iterator[SummaryWriter]:
    """Yield the TensorBoard writers of a trainer; none in any process but the first."""
    if trainer.is_global_zero:
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                yield logger.experiment


def last_step(trainer: L.Trainer) -> int:
    """Return the number under which Lightning logs the scalars of the last optimiser step."""
    return max(0, trainer.global_step - 1)

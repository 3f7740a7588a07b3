"""Lightning's callback and plugin that write and read the checkpoints of a run."""

import os
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import ModelCheckpoint

from dpl.system.files import LOADABLE
from dpl.training.checkpoints import WEIGHTS, read, write


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning plugin that calls `write` and `read`; Lightning's own files can be partial."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None
    ) -> None:
        """Write a checkpoint."""
        write(checkpoint, Path(path))

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Return a checkpoint on the CPU; the message of an error contains the path."""
        try:
            return read(Path(path))
        except ValueError as error:
            raise ValueError(f"{path} {error}") from error


def writes_loadable(callback: Any, trainer: L.Trainer, folder: str | Path) -> bool:
    """Return True if a callback writes a checkpoint from which a run's `folder` is loaded."""
    if not isinstance(callback, ModelCheckpoint) or callback.save_top_k == 0:
        return False
    if callback.monitor is not None and trainer.limit_val_batches == 0:
        return False
    target = Path(folder).resolve() / "checkpoints"
    in_target = callback.dirpath is not None and Path(callback.dirpath).resolve() == target
    named = f"{callback.filename}{callback.FILE_EXTENSION}" in LOADABLE or callback.save_last
    return bool(in_target and named and not getattr(trainer, "fast_dev_run", False))


class BestWeights(ModelCheckpoint):
    """Writes the weights with the smallest finite validation error as a safetensors file."""

    FILE_EXTENSION = WEIGHTS

    def __init__(self, **options: Any) -> None:
        """Take the options of Lightning's `ModelCheckpoint`."""
        super().__init__(save_weights_only=True, **options)

    def check_monitor_top_k(self, trainer: L.Trainer, current: torch.Tensor | None = None) -> bool:
        """Return True if an error is finite and smaller than the previous ones."""
        finite = current is None or bool(current.isfinite())
        return finite and super().check_monitor_top_k(trainer, current)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the best errors, also after the folder was moved with its files."""
        before, here = str(state_dict.get("dirpath")), str(self.dirpath)
        moved = {key: _rebased(value, before, here) for key, value in state_dict.items()}
        files = moved.get("best_k_models")
        is_moved = before != here and files and all(map(os.path.isfile, files))
        super().load_state_dict(moved if is_moved else state_dict)


def _rebased(value: Any, before: str, here: str) -> Any:
    """Return a path, or a mapping of paths, in another folder; other values unchanged."""
    if isinstance(value, dict):
        return {_rebased(path, before, here): error for path, error in value.items()}
    return value.replace(before, here, 1) if isinstance(value, str) else value

"""Checkpoints: files that are whole or not there, and are read without running code.

    RUN/checkpoints/best.safetensors   the weights of the smallest validation error, and whose
    RUN/checkpoints/last.ckpt          all that resuming to the bit takes: optimiser, random numbers

The first is what is handed on: tensors behind a header of JSON. The second is a pickle inside, of
which torch reads tensors and plain data only (`weights_only`).
"""

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import lightning as L
import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import ModelCheckpoint
from safetensors import safe_open
from safetensors.torch import save

from dpl.system.files import atomic_write

WEIGHTS = ".safetensors"
# what stands beside the weights, as JSON
HEADER = ("scene", "identity", "nodes", "epoch", "global_step")
# "best.ckpt" is of runs before weights had files of their own; a short run has only its last
KEPT = (f"best{WEIGHTS}", "best.ckpt", "last.ckpt")  # files of weights that a run is loaded from
RESUMED = {"loops", "callbacks", "optimizer_states", "lr_schedulers"}  # parts that resuming needs
MOST = 8e9  # bytes of a file that is read


def write(checkpoint: dict[str, Any], path: Path) -> None:
    """Write a checkpoint: of a `.safetensors` file its weights and `HEADER`, else all of it.

    What a killed process was writing in its place is removed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for part in path.parent.glob(f".{path.name}.*.part"):
        part.unlink(missing_ok=True)
    with atomic_write(path) as file:
        if path.suffix != WEIGHTS:
            torch.save(checkpoint, file)
            return
        header = {name: checkpoint[name] for name in HEADER if name in checkpoint}
        weights = {name: t.contiguous() for name, t in checkpoint["state_dict"].items()}
        file.write(save(weights, {"dpl": json.dumps(header)}))


def read(path: Path) -> dict[str, Any]:
    """Return what `write` wrote, tensors on the CPU; nothing in the file is called.

    Raises:
        ValueError: It is damaged, of another kind, or larger inside than outside.
        OSError: It cannot be opened.
    """
    if path.stat().st_size > MOST:
        raise ValueError(f"has {path.stat().st_size / 1e9:.3g} GB, of {MOST / 1e9:g} at most")
    try:
        if path.suffix == WEIGHTS:
            return _weights(path)
        with zipfile.ZipFile(path) as archive:  # torch packs without compressing
            inside = sum(member.file_size for member in archive.infolist())
        if inside > path.stat().st_size:
            raise ValueError(f"unpacks to {inside / 1e9:.3g} GB, which no checkpoint does")
        found = torch.load(path, map_location="cpu", weights_only=True)
    except UnpicklingError as error:  # torch advises to read it all the same
        raise ValueError("holds more than tensors and plain data, and is not read") from error
    except OSError:
        raise
    except Exception as error:  # torch raises errors of any kind at a damaged pickle
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"is damaged or no checkpoint: {reason}") from error
    if not isinstance(found, dict) or not isinstance(found.get("state_dict"), dict):
        raise ValueError("is no checkpoint: it holds no weights")
    return found


def epochs(checkpoint: Mapping[str, Any]) -> int:
    """Return how many epochs a checkpoint was written after.

    Raises:
        ValueError: It holds less than resuming takes.
    """
    if missing := RESUMED - checkpoint.keys():
        raise ValueError(
            f"holds no {', '.join(sorted(missing))}, which resuming takes; resume from last.ckpt"
        )
    epoch = checkpoint.get("epoch")
    if not isinstance(epoch, int):
        raise ValueError(f"says epoch = {epoch!r}, which must be a whole number")
    return epoch + 1


def _weights(path: Path) -> dict[str, Any]:
    with safe_open(path, framework="pt") as file:
        header = json.loads((file.metadata() or {}).get("dpl", "null"))
        if not isinstance(header, dict):
            raise ValueError("is no checkpoint: its header names no scene")
        state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    return {**{name: header[name] for name in HEADER if name in header}, "state_dict": state}


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's way to `write` and `read`.

    Its own goes through the default temporary folder; where that is another file system, a kill
    while writing leaves half a file under the final name.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None
    ) -> None:
        """Write a checkpoint."""
        write(checkpoint, Path(path))

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Return a checkpoint, on the CPU.

        Raises:
            ValueError: It cannot be used; the message names it.
        """
        try:
            return read(Path(path))
        except ValueError as error:
            raise ValueError(f"{path} {error}") from error


def keeps(callback: Any, trainer: L.Trainer, folder: str | Path) -> bool:
    """Return whether a callback writes weights from which a run can be loaded.

    Args:
        callback: Of the trainer.
        trainer: The trainer, before it begins.
        folder: The run's.
    """
    if not isinstance(callback, ModelCheckpoint) or callback.save_top_k == 0:
        return False
    if callback.monitor is not None and not _validates(trainer):
        return False
    place = Path(folder).resolve() / "checkpoints"
    there = callback.dirpath is not None and Path(callback.dirpath).resolve() == place
    named = f"{callback.filename}{callback.FILE_EXTENSION}" in KEPT or callback.save_last
    return bool(there and named and not getattr(trainer, "fast_dev_run", False))


def _validates(trainer: L.Trainer) -> bool:
    """Return whether there is a validation before a training ends."""
    every, most = trainer.check_val_every_n_epoch, trainer.max_epochs
    return trainer.limit_val_batches != 0 and (
        every is None or most is None or most == -1 or every <= most
    )


class BestWeights(ModelCheckpoint):
    """The weights of the smallest validation error, as a file of tensors.

    An error that is infinite or not a number is never the smallest.
    """

    FILE_EXTENSION = WEIGHTS

    def __init__(self, **options: Any) -> None:
        """Choose as for Lightning's `ModelCheckpoint`."""
        super().__init__(save_weights_only=True, **options)

    def check_monitor_top_k(self, trainer: L.Trainer, current: torch.Tensor | None = None) -> bool:
        """Return whether an error is finite and smaller than those before."""
        finite = current is None or bool(current.isfinite())
        return finite and super().check_monitor_top_k(trainer, current)

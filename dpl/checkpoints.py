"""Checkpoints: files that are whole or not there, and are read without running code.

    RUN/checkpoints/best.safetensors   the weights of the smallest validation error, and whose
    RUN/checkpoints/last.ckpt          all that resuming to the bit takes: optimiser, random numbers

The first is what is handed on: tensors behind a header of JSON. The second is a pickle inside, of
which torch reads tensors and plain data only (`weights_only`).
"""

import json
import zipfile
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import ModelCheckpoint
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from dpl.data.durable import whole_file

WEIGHTS = ".safetensors"
HEADER = ("scene", "identity", "epoch", "global_step")  # what stands beside the weights, as JSON
MOST = 8e9  # bytes of a file that is read


def write(checkpoint: dict[str, Any], path: Path) -> None:
    """Write a checkpoint: of a `.safetensors` file its weights and `HEADER`, else all of it.

    What a killed process was writing in its place is removed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for part in path.parent.glob(f".{path.name}.*.part"):
        part.unlink(missing_ok=True)
    with whole_file(path) as file:
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
    except (SafetensorError, zipfile.BadZipFile, RuntimeError, EOFError, UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(reason) from error
    if not isinstance(found, dict) or not isinstance(found.get("state_dict"), dict):
        raise ValueError("is no checkpoint: it holds no weights")
    return found


def _weights(path: Path) -> dict[str, Any]:
    with safe_open(path, framework="pt") as file:
        header = json.loads((file.metadata() or {}).get("dpl", "null"))
        if not isinstance(header, dict):
            raise ValueError("is no checkpoint: its header names no scene")
        state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    return {**{name: header[name] for name in HEADER if name in header}, "state_dict": state}


class WholeCheckpoints(TorchCheckpointIO):
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


class BestWeights(ModelCheckpoint):
    """The weights of the smallest validation error, as a file of tensors."""

    FILE_EXTENSION = WEIGHTS

    def __init__(self, **options: Any) -> None:
        """Choose as for Lightning's `ModelCheckpoint`."""
        super().__init__(save_weights_only=True, **options)

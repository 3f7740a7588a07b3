"""Checkpoints: files that are written atomically and read without executing code.

    RUN/checkpoints/best.safetensors   weights with the smallest validation error, and their scene
    RUN/checkpoints/last.ckpt          complete state, which resumes a training bit for bit

The first is a safetensors file with a JSON header. The second is a pickle, from which torch reads
tensors and plain data only (`weights_only`).
"""

import json
import random
import zipfile
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save

from dpl.scene import Scene
from dpl.system.files import atomic_write

WEIGHTS = ".safetensors"
DATA = "DataModule"  # key of the state of the data module, such as a learning curve
HEADER = ("scene", "identity", "nodes", "epoch", "global_step", DATA)  # keys of the JSON header
RESUME_KEYS = {"loops", "callbacks", "optimizer_states", "lr_schedulers"}
MAX_BYTES = 8e9


def write(checkpoint: dict[str, Any], path: Path) -> None:
    """Write a checkpoint atomically; a `.safetensors` file contains only weights and `HEADER`.

    Removes the partial file of a process that was killed while writing the same checkpoint.
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
    """Return a checkpoint written by `write`, tensors on the CPU, without executing code in it.

    Raises:
        ValueError: The file is damaged, no checkpoint, or compressed.
    """
    if (size := path.stat().st_size) > MAX_BYTES:
        raise ValueError(f"has {size / 1e9:.3g} GB; the maximum is {MAX_BYTES / 1e9:g} GB")
    try:
        if path.suffix == WEIGHTS:
            with safe_open(path, framework="pt") as file:
                header = json.loads((file.metadata() or {}).get("dpl", "null"))
                if not isinstance(header, dict):
                    raise ValueError("its header contains no scene")
                state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return {name: header[name] for name in HEADER if name in header} | {"state_dict": state}
        with zipfile.ZipFile(path) as archive:  # torch does not compress
            unpacked = sum(member.file_size for member in archive.infolist())
        if unpacked > size:
            raise ValueError(f"unpacks to {unpacked / 1e9:.3g} GB; a checkpoint is not compressed")
        found = torch.load(path, map_location="cpu", weights_only=True)
    except UnpicklingError as error:  # torch's message advises weights_only=False
        raise ValueError("contains objects other than tensors and plain data") from error
    except OSError:
        raise
    except Exception as error:  # torch raises any kind of error for a damaged pickle
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"is damaged or not a checkpoint: {reason}") from error
    if not isinstance(found, dict) or not isinstance(found.get("state_dict"), dict):
        raise ValueError("is not a checkpoint: it contains no weights")
    return found


def entries_of_scene(scene: Scene) -> dict[str, Any]:
    """Return the entries of a checkpoint by which `check_scene` recognises its scene."""
    nodes = scene.problem.shape[0]
    return {"scene": scene.fingerprint, "identity": scene.identity(), "nodes": nodes}


def check_scene(checkpoint: Mapping[str, Any], scene: Scene) -> None:
    """Raise ValueError if a checkpoint belongs to another scene."""
    stored, identity = checkpoint.get("scene", "unknown"), checkpoint.get("identity", {})
    if stored == scene.fingerprint or scene.matches(identity):
        return
    lines = "".join(f"; {line}" for line in scene.differences(identity))
    raise ValueError(
        f"the checkpoint is of scene {stored[:12]}, this scene is {scene.fingerprint[:12]}{lines}"
    )


def epochs(checkpoint: Mapping[str, Any]) -> int:
    """Return the number of epochs before a checkpoint that can be resumed was written."""
    if missing := RESUME_KEYS - checkpoint.keys():
        raise ValueError(
            f"cannot be resumed: it contains no {', '.join(sorted(missing))}; resume from last.ckpt"
        )
    if not isinstance(epoch := checkpoint.get("epoch"), int):
        raise ValueError(f"has epoch = {epoch!r}, which must be an integer")
    return epoch + 1


def random_states() -> dict[str, Any]:
    """Return the states of all random number generators of this process as tensors and numbers."""
    kind, keys, *rest = np.random.get_state()  # noqa: NPY002 - which other packages use
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "numpy": [kind, torch.from_numpy(np.asarray(keys).astype(np.int64)), *rest],
        "python": random.getstate(),
    }


def set_random_states(states: dict[str, Any]) -> None:
    """Restore the states returned by `random_states`."""
    kind, keys, *rest = states["numpy"]
    torch.set_rng_state(states["torch"].cpu())
    if states["cuda"] and torch.cuda.device_count() == len(states["cuda"]):
        torch.cuda.set_rng_state_all([state.cpu() for state in states["cuda"]])
    np.random.set_state((kind, keys.numpy().astype(np.uint32), *rest))  # noqa: NPY002
    random.setstate(states["python"])

"""Read the folder of a training run.

All functions raise a `ConfigError` where there is no finished run, its files are damaged, or its
configuration is invalid or calls an object that is not trusted.
"""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig, OmegaConf

from dpl import data, inference, training
from dpl.config import validation
from dpl.config.build import SCENE, build_scene, build_trained, instantiate
from dpl.config.plain import error_in, files_of_run, read_config, require_keys, to_container
from dpl.config.validation import ConfigError
from dpl.scene import Scene
from dpl.system.memory import at_most
from dpl.training import checkpoints
from dpl.version import install

MESH = "mesh.vtu"  # name of the copy of a mesh file in the folder of a run
OF_SCENE = (*SCENE, "fixed", "regions")
PREDICTION = (*OF_SCENE, "model", "seed")  # keys of a run that `load` reads
DAMAGED = (  # errors of a damaged checkpoint
    *(OSError, ValueError, TypeError, LookupError),
    *(AttributeError, RuntimeError, ArithmeticError),
)
HUB = "hf://"  # begins the names of runs on the Hugging Face Hub
SHARED = ["config.yaml", "checkpoints/*.safetensors", "*.vtu", "*.npy", "*.npz", "*.safetensors"]


def with_copied_files(
    cfg: DictConfig, folder: Path, *, required: bool = False
) -> tuple[DictConfig, dict[str, tuple[Path, Path]]]:
    """Return a configuration that reads the files of its scene from their copies in a folder.

    The path and the place of the copy of each file, by key, are returned too. Files without a copy
    are read from where they are, or refused if copies are `required`.
    """
    found, files = to_container(cfg), {}
    scene = {key: found[key] for key in OF_SCENE if key in found}
    for key, call, option in list(validation.options_with_files(scene)):
        from dpl.fem import read_mesh  # which imports meshio

        is_mesh = hydra.utils.get_object(call["_target_"]) is read_mesh
        path = Path(call[option])
        own = folder / (MESH if is_mesh else f"{key}{path.suffix}".replace("/", "_"))
        files[key] = path, own
        if os.path.isfile(own) and own.resolve().parent == folder.resolve():
            call[option] = str(own)
            if is_mesh:  # written in metres
                call.pop("scale", None)
        elif required:
            remedy = "write it there by dpl.fem.write_mesh_exactly" if is_mesh else "copy it there"
            raise ConfigError(
                f"{key} = {path} must be kept in the run's folder as {own}; {remedy}, or load the "
                "run with trust=True"
            )
    return OmegaConf.create(found), files


def with_own_data(cfg: DictConfig, folder: Path) -> DictConfig:
    """Return the configuration of a run whose data set is there, or is made in the run's folder."""
    if named := OmegaConf.select(cfg, "data.folder"):
        inside = folder.resolve() in Path(named).resolve().parents
        if not inside and not (Path(named) / "scene.json").is_file():
            cfg.data.folder = str(folder / "data")
    return cfg


def checked_config(
    path: Path,
    *,
    trust: bool | Mapping[str, Any] = False,
    keys: Collection[str] | None = None,
) -> dict[str, Any]:
    """Return the configuration of a run whose objects may be called, or these `keys` of it.

    `trust` allows calls of any object, or of those of another configuration, see
    `dpl.config.validation.check`.
    """
    found = read_config(path)
    found = {key: node for key, node in found.items() if keys is None or key in keys}
    try:
        validation.check(found, found, trust=trust)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return found


def load_run(
    folder: str | Path,
    *,
    trust: bool = False,
    scene: Scene | None = None,
    keys: Collection[str] | None = None,
) -> tuple[DictConfig, "training.TrainedSurrogate"]:
    """Return the configuration and the best surrogate of a training run.

    If the run has chosen its number of training loads (`data=growing`), the number of the best fit
    replaces `data.train` in the configuration. `trust` allows objects outside this package, see
    `load`. `scene` is that of the run, if it is built already. `keys` are the keys of the
    configuration to read, at least `PREDICTION`; None for all.
    """
    config, best = files_of_run(folder)
    cfg = OmegaConf.create(checked_config(config, trust=trust, keys=keys))
    if not trust:
        cfg = with_own_data(cfg, Path(folder))
    with error_in(unusable := f"{best} cannot be used", *DAMAGED):
        checkpoint = checkpoints.read(best)
        if (points := checkpoint.get(checkpoints.DATA, {}).get("points")) and "data" in cfg:
            cfg.data.train = int(points[-1][0])
        weights = [t for t in checkpoint["state_dict"].values() if torch.is_tensor(t)]
        # a damaged or hostile file may state any number of nodes
        nodes = min(sum(t.numel() for t in weights), int(checkpoint.get("nodes", 10**18)))
    if scene is None:
        require_keys(cfg, *SCENE)
        own, _ = with_copied_files(cfg, Path(folder), required=not trust)
        refused = at_most(nodes, f"{best} is of no larger body")
        with contextlib.nullcontext() if trust else refused:
            scene = build_scene(own)
    surrogate = build_trained(cfg, scene)
    with error_in(unusable, *DAMAGED):
        checkpoints.check_scene(checkpoint, scene)
        surrogate.load_state_dict(checkpoint["state_dict"])
        surrogate.eval().check_predictions()
    return cfg, surrogate


def load(folder: str | Path, *, trust: bool = False) -> "inference.Simulator":
    """Return the simulator of a training run.

    Args:
        folder: Folder of the run, as `runs/...`, or a run that was published on the Hugging Face
            Hub, as `hf://OWNER/NAME` or `hf://OWNER/NAME@REVISION`, which needs huggingface_hub.
        trust: Import and call objects outside this package, such as your own law, that the
            configuration names.

    Raises:
        ConfigError: There is no finished run, its checkpoint belongs to another scene, or it names
            an object that is not trusted.
    """
    with _local(str(folder)) as place:
        return inference.Simulator(load_run(place, trust=trust, keys=PREDICTION)[1])


@contextlib.contextmanager
def _local(folder: str) -> Iterator[str | Path]:
    """Provide a folder on this machine with the files of a run."""
    if not folder.startswith(HUB):
        yield folder
        return
    try:
        import huggingface_hub as hub
    except ImportError:
        raise ConfigError(f"{folder} needs huggingface_hub: {install('hub')}") from None
    name, _, revision = folder.removeprefix(HUB).partition("@")
    try:
        found = hub.snapshot_download(name, revision=revision or None, allow_patterns=SHARED)
    except (OSError, ValueError, hub.errors.HfHubHTTPError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ConfigError(f"{folder} cannot be downloaded: {reason}") from error
    with tempfile.TemporaryDirectory() as copy:  # the cache consists of links, which runs refuse
        yield shutil.copytree(found, Path(copy) / "run")


def load_data(cfg: DictConfig, scene: Scene) -> "data.DataModule":
    """Return the data set of a training run on its scene; missing loads are solved."""
    found: data.DataModule = instantiate(cfg, "data", scene=scene)
    found.prepare_data()
    return found

"""Write and read the folder of a training run."""

import typing
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
import torch
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dpl.config import validation
from dpl.config.build import (
    SCENE,
    build_scene,
    build_surrogate,
    check,
    instantiate,
    require_keys,
    to_container,
)
from dpl.config.validation import ConfigError
from dpl.fem import read_mesh as load_mesh
from dpl.fem import write_mesh_exactly
from dpl.scene import Scene
from dpl.system.files import atomic_write
from dpl.system.memory import at_most

if typing.TYPE_CHECKING:
    from dpl.data import OfflineData
    from dpl.inference import Simulator
    from dpl.training import Surrogate

MESH = "mesh.vtu"  # name of the copy of a mesh file in the folder of a run
OF_THE_SESSION = {"run", "folder", "ckpt_path", "callbacks", "logger", "paths", "extras"}
MAX_BYTES = 100_000  # of the configuration of a run


def save_config(cfg: DictConfig, folder: Path) -> None:
    """Write a configuration without interpolations, and a copy of its mesh file, to a folder.

    Raises:
        ConfigError: The folder contains another run that is not resumed.
    """
    there = folder / "config.yaml"
    if (folder / "checkpoints" / "last.ckpt").exists() and not cfg.ckpt_path:
        raise ConfigError(
            f"run = {folder} contains a run; resume it with ckpt_path=last or choose another folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    _copy_mesh(cfg, folder)
    there.write_text(OmegaConf.to_yaml(OmegaConf.create(to_container(cfg))))


def _copy_mesh(cfg: DictConfig, folder: Path) -> None:
    """Write the mesh of a mesh file to a folder."""
    cfg = with_mesh_of_resumed(cfg)
    if not _has_mesh_file(cfg) or Path(cfg.mesh.path) == folder / MESH:
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # printed when the mesh was read first
        mesh = instantiate(cfg, "mesh")
    with atomic_write(folder / MESH) as file:
        write_mesh_exactly(Path(file.name), mesh)


def _has_mesh_file(cfg: DictConfig) -> bool:
    """Return True if a configuration reads its mesh from a file."""
    return hydra.utils.get_object(cfg.mesh._target_) is load_mesh


def _with_mesh(cfg: DictConfig, path: Path) -> DictConfig:
    """Return a configuration that reads its mesh from another file."""
    return OmegaConf.merge(cfg, {"mesh": {"path": str(path)}})


def _resumed(cfg: DictConfig) -> Path | None:
    """Return the path of the checkpoint to resume, None for a new run."""
    last = Path(cfg.folder) / "checkpoints" / "last.ckpt"
    if not cfg.ckpt_path or (cfg.ckpt_path == "last" and not last.exists()):
        return None
    return last if cfg.ckpt_path == "last" else Path(cfg.ckpt_path)


def resumed_config(cfg: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return the configuration of the run to resume, changed by the command line.

    It is `cfg` where no run is resumed. It is also `cfg` where the command line names an option
    that changes several groups, such as `experiment`: it then has to repeat all of them.

    Args:
        cfg: Configuration of the command line.
        overrides: Overrides of the command line, as `key=value`.

    Raises:
        ConfigError: The configuration of the run cannot be read, or it calls an object outside this
            package that the command line does not name.
    """
    checkpoint = _resumed(cfg)
    path = None if checkpoint is None else checkpoint.parent.parent / "config.yaml"
    if path is None or not path.is_file():
        return cfg
    asked = to_container(cfg)
    before = _read_config(path)
    kept = {key: value for key, value in before.items() if key not in OF_THE_SESSION}
    if "trainer" in kept and "trainer" in asked:
        calls = ("_target_", "_partial_", "plugins")  # never those of the file
        kept["trainer"] |= {key: asked["trainer"].get(key) for key in calls}
    unnamed = {k: v for k, v in kept.items() if k != "trainer" and v != asked.get(k)}
    try:
        validation.check(unnamed, unnamed, trust=False)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}; repeat the overrides of the run") from error
    found, given = OmegaConf.create({**asked, **kept}), OmegaConf.create(asked)
    for one in OverridesParser.create().parse_overrides(list(overrides)):
        key = one.key_or_group
        root = key.partition(".")[0]
        if root in OF_THE_SESSION or root.startswith("hydra"):
            continue
        if one.is_delete():
            owner, _, name = key.rpartition(".")
            (OmegaConf.select(found, owner) if owner else found).pop(name, None)
        elif root not in asked:
            return cfg
        else:
            OmegaConf.update(found, key, OmegaConf.select(given, key), merge=False)
    return found


def with_mesh_of_resumed(cfg: DictConfig) -> DictConfig:
    """Return a configuration that reads its mesh file from the copy in the run to resume.

    The original file may have been moved or changed. Without a copy the result is `cfg`.
    """
    if not _has_mesh_file(cfg) or (checkpoint := _resumed(cfg)) is None:
        return cfg
    own = checkpoint.parent.parent / MESH
    return _with_mesh(cfg, own) if own.is_file() else cfg


def check_resumed(cfg: DictConfig) -> dict[str, Any] | None:
    """Return the checkpoint to resume; None for a new run.

    `ckpt_path=last` starts a run that has no checkpoint yet, so that a job has one command line.

    Raises:
        ConfigError: The checkpoint does not exist or cannot be resumed, or its run has another
            configuration, see `dpl.config.validation.changes`.
    """
    if (path := _resumed(cfg)) is None:
        return None
    if not path.is_file():
        raise ConfigError(f"ckpt_path = {path} does not exist; leave it out to start a new run")
    before = path.parent.parent / "config.yaml"
    if before.is_file() and (
        changed := validation.changes(_read_config(before), to_container(cfg))
    ):
        raise ConfigError(
            f"ckpt_path: {path} is of another configuration: {'; '.join(changed)}; "
            "set them back, or begin a run of another name"
        )
    from dpl.training import checkpoints

    try:
        found = checkpoints.read(path)
        done = checkpoints.epochs(found)
    except (OSError, ValueError) as error:
        raise ConfigError(f"ckpt_path = {path} cannot be resumed: it {error}") from error
    most = cfg.trainer.get("max_epochs")
    if most is not None and 0 <= most < done:
        raise ConfigError(
            f"trainer.max_epochs = {most} must be {done} or more; the run in ckpt_path = {path} "
            "has done as many"
        )
    return found


def check_weights(surrogate: "Surrogate", checkpoint: dict[str, Any]) -> None:
    """Check that the checkpoint to resume fits an untrained surrogate.

    Raises:
        ConfigError: It belongs to another scene or network.
    """
    try:
        surrogate.on_load_checkpoint(checkpoint)
    except (ValueError, TypeError, AttributeError) as error:
        raise ConfigError(f"ckpt_path: {error}") from error
    ours, theirs = (
        {name: tuple(t.shape) for name, t in state.items() if isinstance(t, torch.Tensor)}
        for state in (surrogate.state_dict(), checkpoint["state_dict"])
    )
    if differing := sorted(dict(ours.items() ^ theirs.items())):
        raise ConfigError(
            f"ckpt_path: the checkpoint is of another network: {differing[0]} has shape "
            f"{theirs.get(differing[0])} there, {ours.get(differing[0])} here"
        )


def _read_config(path: Path) -> dict[str, Any]:
    """Return the configuration of a run as a dictionary; nothing in it is called or looked up.

    Raises:
        ConfigError: The file is not the configuration of a run.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"has {path.stat().st_size:,} bytes, of {MAX_BYTES:,} at most")
        text = path.read_text()
        marks = yaml.AnchorToken, yaml.AliasToken  # a few lines can expand to gigabytes
        if any(isinstance(token, marks) for token in yaml.scan(text, yaml.SafeLoader)):
            raise ValueError("refers to parts of itself")
        found: Any = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
        if not isinstance(found, dict):
            raise ValueError("is no list of keys and values")
        if any(
            isinstance(value, str) and "${" in value for _, value in validation.iter_nodes(found)
        ):
            raise ValueError("holds an interpolation, which no saved run does")
    except (ValueError, yaml.YAMLError, OmegaConfBaseException, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path} is not the configuration of a run: {reason}") from error
    return found


def load_run(
    folder: str | Path, *, trust: bool = False, scene: Scene | None = None
) -> tuple[DictConfig, "Surrogate"]:
    """Return the configuration and the best surrogate of a training run.

    Args:
        folder: Folder of the run.
        scene: Scene of the run, if it is built already.
        trust: Import and call objects outside this package, such as your own law, that the
            configuration names.

    Raises:
        ConfigError: There is no finished run, or it names an object that is not trusted.
    """
    from dpl.training import checkpoints  # which imports Lightning

    config = Path(folder) / "config.yaml"
    kept = [Path(folder) / "checkpoints" / name for name in checkpoints.LOADABLE]
    best = next((path for path in kept if path.exists()), kept[-1])
    for path in (config, best):
        if not path.is_file():
            raise ConfigError(f"run = {folder} has no {path.relative_to(folder)}; train it first")
    found = _read_config(config)
    for key in ("trainer", "callbacks", "logger"):  # none of their objects is called
        found.pop(key, None)
    cfg = OmegaConf.create(found)
    check(cfg, trust=trust)
    try:
        checkpoint = checkpoints.read(best)
    except (OSError, ValueError, TypeError, KeyError, RuntimeError) as error:
        raise _unusable(best, error) from error
    if scene is None:
        scene = _scene_of_run(cfg, best, checkpoint, trust=trust)
    surrogate = build_surrogate(cfg, scene)
    try:
        surrogate.on_load_checkpoint(checkpoint)
        surrogate.load_state_dict(checkpoint["state_dict"])
    except (ValueError, TypeError, KeyError, RuntimeError) as error:
        raise _unusable(best, error) from error
    return cfg, surrogate.eval()


def _unusable(checkpoint: Path, error: Exception) -> ConfigError:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return ConfigError(f"{checkpoint} cannot be used: {reason}")


def _scene_of_run(
    cfg: DictConfig, weights: Path, checkpoint: dict[str, Any], *, trust: bool
) -> Scene:
    """Return the scene of a run; a mesh file is read from the folder of the run.

    Args:
        cfg: Configuration of the run.
        weights: File of its weights.
        checkpoint: Contents of that file. It bounds the number of nodes: no network has fewer
            weights than its body has nodes.
        trust: Allow more nodes, and a mesh file elsewhere if the run has no copy.

    Raises:
        ConfigError: The run has no copy of its mesh file, or the mesh has too many nodes.
    """
    require_keys(cfg, *SCENE)
    if _has_mesh_file(cfg):
        folder = weights.parent.parent
        own = folder / MESH
        if own.resolve().parent == folder.resolve() and own.is_file():
            cfg = _with_mesh(cfg, own)
        elif not trust:
            raise ConfigError(
                f"mesh.path = {cfg.mesh.path} must be kept in the run's folder as {own}; write it "
                "there (dpl.fem.write_mesh_exactly), or load the run with trust=True"
            )
    if trust:
        return build_scene(cfg)
    values = sum(t.numel() for t in checkpoint["state_dict"].values() if torch.is_tensor(t))
    nodes = checkpoint.get("nodes")
    most = min(nodes, values) if isinstance(nodes, int) else values
    with at_most(most, f"{weights} is of no larger body"):
        return build_scene(cfg)


def load(folder: str | Path, *, trust: bool = False, corrected: bool = False) -> "Simulator":
    """Return the simulator of a training run.

    Args:
        folder: Folder of the run, as `runs/...`.
        trust: Import and call objects outside this package, such as your own law, that the
            configuration names.
        corrected: Solve for equilibrium in the modes of the network before Newton is tried. Only
            for `pod` and `latent`; it needs the data set of the run.

    Raises:
        ValueError: There is no finished run, its checkpoint belongs to another scene, it names an
            object that is not trusted, or its network has no modes.
    """
    from dpl.inference import Simulator

    config, surrogate = load_run(folder, trust=trust)
    if not corrected:
        return Simulator(surrogate)
    return Simulator.corrected(
        surrogate, load_data(config, surrogate.scene).snapshots().displacement
    )


def load_runs(
    folder: str | Path, names: Sequence[str] | None = None, *, trust: bool = False
) -> dict[str, tuple[DictConfig, "Surrogate"]]:
    """Return the configurations and surrogates of the runs in a folder; they share one scene.

    Args:
        folder: Folder of the folders of the runs.
        names: Names of the runs; all if left out.
        trust: See `load_run`.

    Raises:
        ConfigError: There are none, or one cannot be used or belongs to another scene.
    """
    if names is None:
        names = sorted(path.parent.name for path in Path(folder).glob("*/config.yaml"))
    if not names:
        raise ConfigError(f"run = {folder} contains no runs; train some with run={folder}/NAME")
    runs: dict[str, tuple[DictConfig, Surrogate]] = {}
    scene = None
    for name in names:
        runs[name] = load_run(Path(folder) / name, trust=trust, scene=scene)
        scene = runs[name][1].scene
    return runs


def load_data(cfg: DictConfig, scene: Scene) -> "OfflineData":
    """Return the data set of a training run; missing loads are solved.

    Args:
        cfg: Configuration of the run.
        scene: Scene of the run.

    Raises:
        ConfigError: The data set cannot be built.
    """
    data = instantiate(cfg, "data", scene=scene)
    data.prepare_data()
    return data

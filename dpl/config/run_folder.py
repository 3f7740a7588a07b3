"""Write and read the folder of a training run."""

import typing
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
import torch
import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dpl.config import validation
from dpl.config.build import (
    SCENE,
    _need,
    build_scene,
    build_surrogate,
    check,
    instantiate,
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

MESH = "mesh.vtu"  # copy of the mesh file in the folder of a run
LONGEST = 100_000  # bytes of a run's configuration


def save_config(cfg: DictConfig, folder: Path) -> None:
    """Write a configuration, resolved, into a run's folder, and a copy of the mesh file it names.

    Raises:
        ConfigError: The folder holds a run already, and this one does not resume it.
    """
    there = folder / "config.yaml"
    if (folder / "checkpoints" / "last.ckpt").exists() and not cfg.ckpt_path:
        raise ConfigError(
            f"run: {folder} holds a run; resume it with ckpt_path=last or name another"
        )
    folder.mkdir(parents=True, exist_ok=True)
    _keep_mesh(cfg, folder)
    there.write_text(OmegaConf.to_yaml(OmegaConf.create(to_container(cfg))))


def _keep_mesh(cfg: DictConfig, folder: Path) -> None:
    """Write the mesh file of a configuration into a run's folder, as `MESH`."""
    cfg = with_mesh_of_resumed(cfg)
    if not _is_file(cfg) or Path(cfg.mesh.path) == folder / MESH:
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it was read before, and they were shown
        mesh = instantiate(cfg, "mesh")
    with atomic_write(folder / MESH) as file:
        write_mesh_exactly(Path(file.name), mesh)


def _is_file(cfg: DictConfig) -> bool:
    """Return whether the mesh of a configuration is read from a file."""
    return hydra.utils.get_object(cfg.mesh._target_) is load_mesh


def _with_mesh(cfg: DictConfig, path: Path) -> DictConfig:
    """Return a configuration that reads its mesh, if that is a file, from another one."""
    return OmegaConf.merge(cfg, {"mesh": {"path": str(path)}})


def _resumed(cfg: DictConfig) -> Path | None:
    """Return the checkpoint that a configuration resumes, None if it begins a run."""
    last = Path(cfg.folder) / "checkpoints" / "last.ckpt"
    if not cfg.ckpt_path or (cfg.ckpt_path == "last" and not last.exists()):
        return None
    return last if cfg.ckpt_path == "last" else Path(cfg.ckpt_path)


def with_mesh_of_resumed(cfg: DictConfig) -> DictConfig:
    """Return a configuration that reads its mesh file, if it names one, from the run it resumes.

    The original may have been moved or changed.
    """
    if not _is_file(cfg) or (checkpoint := _resumed(cfg)) is None:
        return cfg
    own = checkpoint.parent.parent / MESH
    return _with_mesh(cfg, own) if own.is_file() else cfg


def check_resumed(cfg: DictConfig) -> dict[str, Any] | None:
    """Return the checkpoint that a run resumes; None if it begins anew.

    `ckpt_path=last` of a run that has not begun begins it: a job has one command line.

    Raises:
        ConfigError: There is no such checkpoint, it cannot be resumed, or its run differs in what
            makes the run what it is.
    """
    if (path := _resumed(cfg)) is None:
        return None
    if not path.is_file():
        raise ConfigError(f"ckpt_path: there is no {path} to resume; leave it out to begin anew")
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
    """Hold the checkpoint that a run resumes against its untrained surrogate.

    Raises:
        ConfigError: It is of another scene or of another network.
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
    """Return the configuration of a run, plain data: nothing in it is called or looked up.

    Raises:
        ConfigError: It is none.
    """
    try:
        if path.stat().st_size > LONGEST:
            raise ValueError(f"has {path.stat().st_size:,} bytes, of {LONGEST:,} at most")
        text = path.read_text()
        marks = yaml.AnchorToken, yaml.AliasToken  # a few lines of which unfold to gigabytes
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
        folder: The run's.
        scene: Its scene, where that is there already; built anew if left out.
        trust: Whether its configuration may name objects outside this package, such as your own
            law: they are imported and called.

    Raises:
        ConfigError: There is no finished run, or it names what is not trusted.
    """
    from dpl.training import checkpoints  # which imports Lightning

    config = Path(folder) / "config.yaml"
    kept = [Path(folder) / "checkpoints" / name for name in checkpoints.LOADABLE]
    best = next((path for path in kept if path.exists()), kept[-1])
    for path in (config, best):
        if not path.is_file():
            raise ConfigError(f"run = {folder} has no {path.relative_to(folder)}; train it first")
    found = _read_config(config)
    found.pop("trainer", None)  # of which nothing is called
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
    """Return the scene of a run, its mesh read from its folder and held to its weights.

    Args:
        cfg: Its configuration.
        weights: The file of its weights, in its folder.
        checkpoint: What is in it. A body has no more nodes than weights have numbers, of any
            network.
        trust: Whether the mesh may have more nodes, and lie elsewhere if the run has no copy.

    Raises:
        ConfigError: The run has no copy of its mesh file, or the mesh has too many nodes.
    """
    _need(cfg, *SCENE)
    if _is_file(cfg):
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
        folder: The run's, as `runs/...`.
        trust: Whether its configuration may name objects outside this package, such as your own
            law: they are imported and called.
        corrected: Put equilibrium in the network's modes between it and Newton; for `pod` and
            `latent`, and it needs the run's data set.

    Raises:
        ValueError: There is no finished run, its checkpoint is of another scene, it names what is
            not trusted, or its network has no modes.
    """
    from dpl.inference import Simulator

    config, surrogate = load_run(folder, trust=trust)
    if not corrected:
        return Simulator(surrogate)
    return Simulator.corrected(
        surrogate, load_data(config, surrogate.scene).snapshots().displacement
    )


def load_runs(
    folder: str | Path, names: Sequence[str] | None = None
) -> dict[str, tuple[DictConfig, "Surrogate"]]:
    """Return the configurations and surrogates of the runs in a folder; they share one scene.

    Args:
        folder: That holds the folders of runs.
        names: Of those; all if left out.

    Raises:
        ConfigError: There are none, or one cannot be used or belongs to another scene.
    """
    if names is None:
        names = sorted(path.parent.name for path in Path(folder).glob("*/config.yaml"))
    if not names:
        raise ConfigError(f"run: {folder} holds no runs; train some with run={folder}/NAME")
    runs: dict[str, tuple[DictConfig, Surrogate]] = {}
    scene = None
    for name in names:
        runs[name] = load_run(Path(folder) / name, scene=scene)
        scene = runs[name][1].scene
    return runs


def load_data(cfg: DictConfig, scene: Scene) -> "OfflineData":
    """Return the data set of a training run, made where it is missing.

    Args:
        cfg: The run's configuration.
        scene: Its scene.

    Raises:
        ConfigError: It cannot be made.
    """
    data = instantiate(cfg, "data", scene=scene)
    data.prepare_data()
    return data

"""Begin or resume a training run: write its configuration, compare it with that of the run.

All functions raise a `ConfigError` where the run cannot be resumed.
"""

import shutil
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from dpl import training
from dpl.config import validation
from dpl.config.build import instantiate
from dpl.config.plain import NOT_IDENTITY, OF_THE_SESSION, error_in, read_config, to_container
from dpl.config.run_folder import MESH, checked_config, with_copied_files, with_own_data
from dpl.config.validation import ConfigError
from dpl.fem import write_mesh_exactly
from dpl.system.files import atomic_write

OF_GRADIENT_DESCENT = ("loss", "optimizer", "scheduler", "trainer")  # not stored for fitted models
MACHINE = tuple(f"trainer.{key}" for key in ("accelerator", "devices", "num_nodes", "strategy"))
MAY_CHANGE_ON_RESUME = {  # keys of the length of a run and of the machine
    *(f"trainer.max_{unit}" for unit in ("epochs", "steps", "time")),
    *MACHINE,
    *("trainer.log_every_n_steps", "trainer.check_val_every_n_epoch", "trainer.profiler"),
    *("trainer.enable_progress_bar", "trainer.enable_model_summary"),
    *("data.workers", "data.timeout", "tags"),
    *(f"data.train.{limit}" for limit in ("error", "minutes", "max_train")),
}


def save_config(cfg: DictConfig, folder: Path, *, without: Collection[str] = ()) -> None:
    """Write a configuration without interpolations, and copies of its files, to a folder.

    The keys `without` are left out. A mesh is written as it was checked; other files are copied
    byte for byte. A folder with another run that is not resumed is refused.
    """
    if (folder / "checkpoints" / "last.ckpt").exists() and not cfg.ckpt_path:
        raise ConfigError(
            f"run = {folder} contains a run; resume it with ckpt_path=last or choose another folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    source = with_files_of_resumed(cfg)
    for path, own in with_copied_files(source, folder)[1].values():
        if path == own:
            continue
        with path.open("rb") as origin, atomic_write(own) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # printed when the mesh was read first
            if own.name == MESH:
                write_mesh_exactly(Path(file.name), instantiate(source, "mesh"))
            else:
                shutil.copyfileobj(origin, file)
    kept = {key: node for key, node in to_container(cfg).items() if key not in without}
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(kept)))


def _resumed(cfg: DictConfig) -> Path | None:
    """Return the path of the checkpoint to resume, None for a new run."""
    last = Path(cfg.folder) / "checkpoints" / "last.ckpt"
    if cfg.ckpt_path == "last":
        return last if last.exists() else None
    return Path(cfg.ckpt_path) if cfg.ckpt_path else None


def resumed_config(cfg: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return the configuration of the run to resume, changed by the command line.

    It is `cfg`, that of the command line, where no run is resumed, and where the command line names
    an option that changes several groups, such as `experiment`: it then has to repeat all of them.
    An option of the group `trainer` changes the machine alone, one of the group `data` nothing if
    the run has the same kind of data: it lets keys of this kind be given. The run may call objects
    outside this package that `cfg` calls in the same place, and any with `trust=true`.
    """
    checkpoint = _resumed(cfg)
    path = None if checkpoint is None else checkpoint.parent.parent / "config.yaml"
    if path is None or not path.is_file():
        return cfg
    requested = to_container(cfg)
    before = checked_config(path, trust=cfg.get("trust") or requested)
    kept = {key: value for key, value in before.items() if key not in OF_THE_SESSION}
    found, given = OmegaConf.create({**requested, **kept}), OmegaConf.create(requested)
    found = with_own_data(found, path.parent)
    for one in OverridesParser.create().parse_overrides(list(overrides)):
        key = one.key_or_group
        root = key.partition(".")[0]
        if root in OF_THE_SESSION or root.startswith("hydra"):
            continue
        if one.is_delete():
            owner, _, name = key.rpartition(".")
            (OmegaConf.select(found, owner) if owner else found).pop(name, None)
        elif root not in requested:
            return cfg
        elif key != "data" or _kind_of_data(found) != _kind_of_data(given):
            machine = [one for one in MACHINE if OmegaConf.select(given, one) is not None]
            for place in machine if key == "trainer" else [key]:
                OmegaConf.update(found, place, OmegaConf.select(given, place), merge=False)
    return found


def _kind_of_data(cfg: DictConfig) -> Any:
    """Return the class of the source of the training samples; None for a number of loads."""
    train = OmegaConf.select(cfg, "data.train")
    return train.get("_target_") if isinstance(train, DictConfig) else None


def with_files_of_resumed(cfg: DictConfig) -> DictConfig:
    """Return a configuration that reads its files from the copies in the run to resume, if any."""
    path = _resumed(cfg)
    return cfg if path is None else with_copied_files(cfg, path.parent.parent)[0]


def check_resumed(cfg: DictConfig) -> dict[str, Any] | None:
    """Return the checkpoint to resume, of a run with the same configuration; None for a new run.

    `ckpt_path=last` starts a run that has no checkpoint yet, so that a job has one command line.
    """
    from dpl.training import checkpoints

    if (path := _resumed(cfg)) is None:
        return None
    if not path.is_file():
        raise ConfigError(f"ckpt_path = {path} does not exist; leave it out to start a new run")
    before = path.parent.parent / "config.yaml"
    ours = to_container(cfg)
    if before.is_file() and (changed := _changes(read_config(before), ours)):
        raise ConfigError(
            f"ckpt_path: {path} is of another configuration: {'; '.join(changed)}; "
            "set them back, or begin a run of another name"
        )
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


def check_weights(
    surrogate: "training.Surrogate", checkpoint: dict[str, Any], *, grows: bool = False
) -> None:
    """Check that the checkpoint to resume is of the scene and network of an untrained surrogate.

    A model that is fitted is resumed only where its data set `grows`, so that it is fitted again.
    """
    with error_in("ckpt_path", ValueError, TypeError, AttributeError, RuntimeError):
        surrogate.on_load_checkpoint(checkpoint)
        if not surrogate.predictor.is_closed_form:  # Lightning loads them again
            surrogate.load_state_dict(checkpoint["state_dict"])
        elif not grows:  # else the sizes of its buffers are results of the fit
            name = type(surrogate.net).__name__
            raise ConfigError(
                f"ckpt_path: {name} is fitted in one step and cannot be resumed; remove it"
            )


def check_callbacks(trainer: Any, checkpoint: dict[str, Any]) -> None:
    """Check that a trainer continues the average of the weights of the checkpoint to resume."""
    averages = any(isinstance(one, training.AveragedWeights) for one in trainer.callbacks)
    stored = checkpoint.get("callbacks")  # a mapping; another type is refused by Lightning
    name = training.AveragedWeights.__name__
    if not averages and isinstance(stored, dict) and any(str(k).startswith(name) for k in stored):
        raise ConfigError("ckpt_path: the run averages its weights; add callbacks=ema")


def _changes(theirs: dict[str, Any], ours: dict[str, Any]) -> list[str]:
    """Return the differences that a resumed run must not have from its configuration, as lines."""
    before, now = (
        {key: one for key, one in validation.iter_nodes(node) if not isinstance(one, dict | list)}
        for node in (theirs, ours)
    )
    unused = (key for key in OF_GRADIENT_DESCENT if key not in theirs)
    free = tuple(f"{key}." for key in (*NOT_IDENTITY, *MAY_CHANGE_ON_RESUME, *unused))
    return [
        f"{key} was {before.get(key)}, is {now.get(key)}"
        for key in sorted(before.keys() | now.keys())
        if before.get(key) != now.get(key) and not f"{key}.".startswith(free)
    ]

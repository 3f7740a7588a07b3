"""Configurations as plain data: read, resolve, flatten and check them.

This module imports neither torch nor a class that a configuration names, so that a wrong key or a
missing run is reported at once.
"""

import contextlib
import typing
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    InterpolationToMissingValueError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)

from dpl.config import validation
from dpl.config.validation import ConfigError
from dpl.system.files import LOADABLE, DataSetError

MAX_BYTES = 100_000  # of the configuration of a run
# keys that a resumed run takes from the command line
OF_THE_SESSION = {"run", "folder", "ckpt_path", "trust", "callbacks", "logger", "paths", "extras"}
NOT_IDENTITY = OF_THE_SESSION | {"data.folder", "trainer.plugins"}  # keys without effect on results


@contextlib.contextmanager
def error_in(key: str, *kinds: type[Exception]) -> Iterator[None]:
    """Turn a ValueError, or errors of these kinds, into a `ConfigError` that names a key.

    Without a key, the message of the error names it. A `ConfigError` and a `DataSetError` remain
    what they are: their messages name the place. A message ends after 100 words, since torch lists
    all weights that do not fit.
    """
    kinds = kinds or (ValueError,)
    try:
        yield
    except (ConfigError, DataSetError):
        raise
    except kinds as error:
        reason = " ".join(str(error).split()[:100]) or type(error).__name__
        raise ConfigError(f"{key}: {reason}" if key else reason) from error


def to_container(cfg: DictConfig) -> dict[str, Any]:
    """Return a configuration without interpolations; raise a `ConfigError` for a missing value."""
    try:
        found: Any = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
        return typing.cast("dict[str, Any]", found)
    except OmegaConfBaseException as error:
        message = str(error.msg or error).splitlines()[0]
        missing = isinstance(error, MissingMandatoryValue) and error.full_key
        if isinstance(error, InterpolationToMissingValueError):  # another key needs its value
            missing = message.rpartition(": ")[2]
        if missing:
            raise ConfigError(f"{missing} is missing; set it on the command line") from None
        raise ConfigError(f"{error.full_key or 'config'}: {message}") from None


def hyperparameters(cfg: DictConfig, *, without: Collection[str] = ()) -> dict[str, Any]:
    """Return the hyperparameters of a run, flat: keys of the command line and their values.

    A call has the key of its node and the name of its class (`model`: FCNN). Null, empty lists and
    `NOT_IDENTITY` are left out, and so are the nodes `without`.
    """
    kept = {key: node for key, node in to_container(cfg).items() if key not in without}
    return dict(_columns(kept, ""))


def _columns(node: dict[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        place = f"{path}.{key}" if path else key
        if value in (None, []) or place in NOT_IDENTITY:
            continue
        if isinstance(value, dict):
            yield from _columns(value, place)
        elif key == "_target_":
            yield path, value.rpartition(".")[2]
        elif not key.startswith("_"):
            yield place, str(value) if isinstance(value, list) else value


def check(cfg: DictConfig, *, trust: bool = True, keys: validation.Keys = ()) -> None:
    """Check a configuration without calling anything, see `dpl.config.validation.check`."""
    written = typing.cast("dict[str, Any]", OmegaConf.to_container(cfg))
    validation.check(written, to_container(cfg), trust=trust, keys=keys)


def require_keys(cfg: DictConfig, *keys: str) -> None:
    """Raise a `ConfigError` if a key does not exist."""
    if absent := [key for key in keys if key not in cfg]:
        raise ConfigError(f"{absent[0]} is missing")


def read_config(path: Path) -> dict[str, Any]:
    """Return the configuration of a run as a dictionary; nothing in it is called or looked up."""
    damaged = ValueError, yaml.YAMLError, OmegaConfBaseException, RecursionError
    with error_in(f"{path} is not the configuration of a run", *damaged):
        if (size := path.stat().st_size) > MAX_BYTES:
            raise ValueError(f"has {size:,} bytes, of {MAX_BYTES:,} at most")
        text = path.read_text()
        marks = yaml.AnchorToken, yaml.AliasToken  # a few lines can expand to gigabytes
        if any(isinstance(token, marks) for token in yaml.scan(text, yaml.SafeLoader)):
            raise ValueError("refers to parts of itself")
        found: Any = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
        if not isinstance(found, dict):
            raise ValueError("is no list of keys and values")
        if any(isinstance(one, str) and "${" in one for _, one in validation.iter_nodes(found)):
            raise ValueError("holds an interpolation, which no saved run does")
    return typing.cast("dict[str, Any]", found)


def files_of_run(folder: str | Path) -> tuple[Path, Path]:
    """Return the paths of the configuration and of the best weights of a run, which exist."""
    config = Path(folder) / "config.yaml"
    kept = [Path(folder) / "checkpoints" / name for name in LOADABLE]
    best = next((path for path in kept if path.exists()), kept[-1])
    for path in (config, best):
        if not path.is_file():
            raise ConfigError(f"run = {folder} has no {path.relative_to(folder)}; train it first")
    return config, best


def options_of_run(folder: Path) -> dict[str, Any]:
    """Return the hyperparameters of a run, see `hyperparameters`; none without configuration."""
    path = folder / "config.yaml"
    return hyperparameters(OmegaConf.create(read_config(path))) if path.is_file() else {}

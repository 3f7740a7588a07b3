"""Parse and compose the overrides of a command line; explain invalid ones in one line.

All functions need an initialised Hydra (`dpl.commands.dry_run.initialized`).
"""

import difflib
import re
from collections.abc import Sequence
from typing import Any

import hydra
from hydra.core.default_element import ResultDefault
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dpl.config import ConfigError, validation
from dpl.version import install

EXTRAS = {"hydra/launcher": "launch", "hydra/sweeper": "sweep"}  # groups with options of plugins
SIMILAR = 0.8  # ratio of `difflib` from which a key is taken for a misspelt one
GROUP = re.compile(r"[\w.:][\w .:+-]*")  # a name of a group of a mesh that needs no quotes
REFUSED = (HydraException, OmegaConfBaseException, ValueError, AssertionError, TypeError)


def _loader() -> Any:
    return GlobalHydra.instance().config_loader()


def options(name: str, group: str) -> list[str]:
    """Return the options of a group of a command; none if the group does not exist."""
    path = group.partition("@")[0]
    return sorted(_loader().get_group_options(path, ObjectType.CONFIG, config_name=name))


def defaults(name: str, lines: list[str]) -> list[ResultDefault]:
    """Return the files that a configuration is composed of, in their order."""
    return list(_loader().compute_defaults_list(name, lines, RunMode.RUN).defaults)


def with_named_region(name: str, lines: Sequence[str]) -> list[str]:
    """Return overrides in which `fixed=GROUP`, a group of the mesh, selects `fixed/tag.yaml`."""
    found: list[str] = []
    for line in lines:
        key, _, group = line.partition("=")
        is_option = group in ("null", *options(name, key)) or not GROUP.fullmatch(group)
        found += [line] if key != "fixed" or is_option else ["fixed=tag", f"fixed.name={group}"]
    return found


def parsed(line: str) -> Override:
    """Return an override; raise a `ConfigError` if it cannot be parsed."""
    try:
        return OverridesParser.create(config_loader=_loader()).parse_override(line)
    except HydraException as error:
        if "=" not in line:
            raise ConfigError(f"{line} must be written as KEY=VALUE") from error
        key = line.partition("=")[0]
        raise ConfigError(f"{line} cannot be read; quote the value: '{key}=\"...\"'") from error


def composed(name: str, lines: Sequence[str]) -> DictConfig:
    """Return the configuration of a command with overrides, including the node `hydra`.

    Raises a `ConfigError` if an override cannot be applied: with the most similar key of the same
    node if there is one, else with the message of Hydra.
    """
    try:
        cfg = hydra.compose(name, overrides=list(lines), return_hydra_config=True)
    except REFUSED as error:
        _check_spelling(name, lines, str(error))
        raise ConfigError(_in_one_line(str(error))) from error
    keys = {line[1:].lstrip("+").partition("=")[0] for line in lines if line[0] == "+"}
    if new := {key for key in keys if "." not in key and not options(name, key)}:
        known = {str(key) for key in hydra.compose(name)}
        for key in new - known:
            message = validation.suggestion(key, known)
            raise ConfigError(f"{key}: this command has no such key; {message}")
    return cfg


def job(cfg: DictConfig) -> DictConfig:
    """Return the configuration of a job without the node `hydra`, which sets `folder` later."""
    found = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
    if "folder" in found and OmegaConf.is_interpolation(found, "folder"):
        found.folder = "."
    return found


def _check_spelling(name: str, lines: Sequence[str], message: str) -> None:
    """Raise a `ConfigError` if the key that Hydra refuses resembles a key of the same node."""
    if found := re.match(r"Could not override '((?:([\w.]+)\.)?(\w+))'", message):
        others = [line for line in lines if not line.startswith(f"{found[1]}=")]
        try:
            cfg = hydra.compose(name, overrides=others)
        except REFUSED:  # its message names the first of several
            return
        node = OmegaConf.select(cfg, found[2]) if found[2] else cfg
        known = [*map(str, node)] if isinstance(node, DictConfig) else []
        if near := difflib.get_close_matches(found[3], known, 1, SIMILAR):
            place = ".".join(filter(None, (found[2], near[0])))
            raise ConfigError(f"{found[1]}: there is no such key; did you mean {place}?")


def _in_one_line(message: str) -> str:
    """Return a message of Hydra, with the remedy where the option of a plugin is missing."""
    lines = message.partition("Config search path")[0].splitlines()
    text = " ".join(line.strip() for line in lines if line and "full_key" not in line)
    for group, extra in EXTRAS.items():
        if f"'{group}/" in text:
            text += f"; more come with {install(extra)}"
    return text

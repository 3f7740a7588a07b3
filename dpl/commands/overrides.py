"""Parse and compose the overrides of a command line; explain invalid ones in one line.

Hydra explains an invalid override in several lines, with advice that the next check may refuse.
This module raises one `ConfigError` instead. All functions need an initialised Hydra
(`hydra.initialize_config_dir`).
"""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dpl.config import ConfigError, validation
from dpl.version import install

EXTRAS = {"hydra/launcher": "launch", "hydra/sweeper": "sweep"}  # groups with options of plugins
REFUSED = (HydraException, OmegaConfBaseException, ValueError, AssertionError, TypeError)


def parsed(line: str) -> Override:
    """Return an override.

    Raises:
        ConfigError: It cannot be parsed.
    """
    try:
        return OverridesParser.create(config_loader=_loader()).parse_override(line)
    except HydraException as error:
        if "=" not in line:
            raise ConfigError(f"{line} must be written as KEY=VALUE") from error
        key = line.partition("=")[0]
        raise ConfigError(f"{line} cannot be read; quote the value: '{key}=\"...\"'") from error


def composed(name: str, lines: Sequence[str]) -> DictConfig:
    """Return the configuration of a command with overrides, including the node `hydra`.

    Raises:
        ConfigError: An override cannot be applied.
    """
    try:
        cfg = hydra.compose(name, overrides=list(lines), return_hydra_config=True)
    except REFUSED as error:
        raise ConfigError(_reason(name, [parsed(line) for line in lines], error)) from error
    added = [one.partition("=")[0].lstrip("+") for one in lines if one.startswith("+")]
    if new := [key for key in added if "." not in key and not options(key)]:
        known = {str(key) for key in hydra.compose(name)}
        for key in new:
            if key not in known:
                told = validation.suggestion(key, known)
                raise ConfigError(f"{key}: this command has no such key; {told}")
    return cfg


def values(one: Override, *, search: bool) -> list[str]:
    """Return one override for each value of a sweep over a key.

    Args:
        one: The override.
        search: Return the ends of a range.

    Raises:
        ConfigError: There is no value, or it is a range without a search.
    """
    if one.is_discrete_sweep():
        found = [f"{one.get_key_element()}={value}" for value in one.sweep_string_iterator()]
    elif search and one.is_interval_sweep():
        interval: Any = one.value()
        found = [f"{one.get_key_element()}={value}" for value in (interval.start, interval.end)]
    else:
        raise ConfigError(
            f"{one.input_line} is a range for a search; name its values, or add "
            "hydra/sweeper=optuna"
        )
    if not found:
        raise ConfigError(f"{one.input_line} must name one value or more; it names none")
    return found


def _loader() -> Any:
    return GlobalHydra.instance().config_loader()


def options(group: str) -> list[str]:
    """Return the options of a group; none if the group does not exist."""
    return sorted(_loader().get_group_options(group.partition("@")[0], ObjectType.CONFIG))


def folders() -> list[Path]:
    """Return the folders in which Hydra searches for configurations."""
    search = _loader().get_search_path().get_path()
    return [Path(one.path.removeprefix("file://")) for one in search if "://" not in one.path[7:]]


def _reason(name: str, asked: list[Override], error: Exception) -> str:
    """Return one line that explains why overrides cannot be applied."""
    groups = [one for one in asked if options(one.key_or_group)]
    with contextlib.suppress(*REFUSED):
        chosen = set(hydra.compose(name, return_hydra_config=True).hydra.runtime.choices)
        found = [_bad_option(one, chosen, str(error)) for one in groups]
        if told := next(filter(None, found), None):
            return told
        ways = [one for one in asked if one.key_or_group == "hydra.searchpath"]
        lines = [one.input_line for one in (*ways, *groups)]
        base = hydra.compose(name, overrides=lines, return_hydra_config=True)
        found = [_bad_key(one, base) for one in asked if one not in groups]
        if told := next(filter(None, found), None):
            return told
    told = str(error).partition("Config search path")[0]
    return " ".join(line.strip() for line in told.splitlines() if "://" not in line)


def _bad_option(one: Override, chosen: set[str], error: str) -> str | None:
    """Return the problem of the choice of an option, None if it is valid.

    Args:
        one: The choice.
        chosen: Groups of the command.
        error: Hydra's message, which names a missing option.
    """
    value, group = one.value(), one.key_or_group
    known, adds = options(group), one.is_add() or one.is_force_add()
    if adds and group in chosen:
        return f"{group}: an option is chosen already; write {one.input_line.lstrip('+')}"
    if not adds and group not in chosen:
        return f"{group}: this command has no such key; {validation.suggestion(group, chosen)}"
    missing = f"{group}/{value}" in error or not isinstance(value, str)
    if one.is_delete() or isinstance(value, list) or value in known or not missing:
        return None
    near = validation.nearest_name(str(value), known)
    told = f"{group} = {'null' if value is None else value}: there is no such option; "
    told += f"did you mean {near}? " if near else ""
    told += f"{group} is one of {', '.join(known)}"
    told += f"; ~{group} leaves it out" if value is None else ""
    return told + (f"; more come with {install(EXTRAS[group])}" if group in EXTRAS else "")


def _bad_key(one: Override, base: DictConfig) -> str | None:
    """Return the problem of a key that is set, added or removed, None if it is valid."""
    key, adds = one.key_or_group, one.is_add() or one.is_force_add()
    if "/" in key:
        parent = key.rpartition("/")[0]
        groups = _loader().get_group_options(parent, ObjectType.GROUP)
        told = validation.suggestion(key, {f"{parent}/{group}" for group in groups})
        return f"{key}: there is no such group; {told}"
    node: Any = base
    place = ""
    for part in key.split("."):
        known = _below(node)
        if part in known and OmegaConf.is_list(node) and one.is_delete() and key == place + part:
            return f"{key} is an entry of a list, which cannot be removed; write the whole list"
        if part in known:
            node, place = known[part], f"{place}{part}."
            continue
        if adds:
            return None
        more = validation.options_of(node) if OmegaConf.is_dict(node) else set()
        if key == place + part and part in more and not one.is_delete():
            return f"{key} is not in this configuration; add it with +{one.input_line}"
        names = {name for name in known if name[0] != "_"} - {"hydra"} | more
        return f"{key}: there is no such key; {validation.suggestion(part, names, place)}"
    return None


def _below(node: Any) -> dict[str, Any]:
    """Return the entries of a node by name or number, without resolving interpolations."""
    if not OmegaConf.is_config(node) or node._is_none() or node._is_missing():
        return {}
    keys = node.keys() if OmegaConf.is_dict(node) else range(len(node))
    return {str(key): node._get_node(key) for key in keys}

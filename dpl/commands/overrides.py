"""Parse and compose the overrides of a command line; explain invalid ones in one line.

Hydra explains an invalid override in several lines, with advice that the next check may refuse.
All functions need an initialised Hydra (`dpl.commands.dry_run.initialized`).
"""

import contextlib
import difflib
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

    Raises a `ConfigError` if an override cannot be applied.
    """
    try:
        cfg = hydra.compose(name, overrides=list(lines), return_hydra_config=True)
    except REFUSED as error:
        raise ConfigError(_reason(name, [parsed(line) for line in lines], error)) from error
    added = [one.partition("=")[0].lstrip("+") for one in lines if one.startswith("+")]
    if new := [key for key in added if "." not in key and not options(name, key)]:
        known = {str(key) for key in hydra.compose(name)}
        for key in set(new) - known:
            message = validation.suggestion(key, known)
            raise ConfigError(f"{key}: this command has no such key; {message}")
    return cfg


def values(one: Override, *, search: bool) -> list[str]:
    """Return one override for each value of a sweep, and for the ends of a range in a search."""
    if one.is_discrete_sweep():
        found = list(one.sweep_string_iterator())
    elif search and one.is_interval_sweep():
        interval: Any = one.value()
        found = [interval.start, interval.end]
    else:
        raise ConfigError(
            f"{one.input_line} is a range for a search; name its values, or add "
            "hydra/sweeper=optuna"
        )
    if not found:
        raise ConfigError(f"{one.input_line} must name one value or more; it names none")
    return [f"{one.get_key_element()}={value}" for value in found]


def _reason(name: str, requested: list[Override], error: Exception) -> str:
    """Return one line: the nearest name of an unknown key or option, else the message of Hydra."""
    groups = [one for one in requested if options(name, one.key_or_group)]
    for one in groups:
        if not one.is_delete() and (message := _bad_option(one, options(name, one.key_or_group))):
            return message
    with contextlib.suppress(*REFUSED):
        ways = [one for one in requested if one.key_or_group == "hydra.searchpath"]
        chosen = [one for one in groups if one.key_or_group in hydra.compose(name)]
        lines = [one.input_line for one in (*ways, *chosen)]
        base = hydra.compose(name, overrides=lines, return_hydra_config=True)
        known = {*base, *base.hydra.runtime.choices}
        for one in requested:
            key = one.key_or_group
            is_new = one.is_add() or one.is_force_add() or "/" in key or key in known
            if not is_new and (message := _unknown(key, base)):
                return message
    message = str(error).partition("Config search path")[0]
    return " ".join(line.strip() for line in message.splitlines() if "full_key" not in line)


def _bad_option(one: Override, known: list[str]) -> str | None:
    """Return the problem of the choice of an option, None if it is valid."""
    value, group = one.value(), one.key_or_group
    if isinstance(value, list) or value in known:
        return None
    near = difflib.get_close_matches(str(value), known, 1)
    advice = f"did you mean {near[0]}? " if near else ""
    message = f"{group} = {'null' if value is None else value}: there is no such option; "
    message += f"{advice}{group} is one of {', '.join(known)}"
    if value is None:
        message += f"; ~{group} leaves it out"
    return f"{message}; more come with {install(EXTRAS[group])}" if group in EXTRAS else message


def _unknown(key: str, base: DictConfig) -> str | None:
    """Return the advice for a key that does not exist in a configuration, None if it may."""
    node: Any = OmegaConf.to_container(base)
    place = ""
    for part in key.split("."):
        known = _below(node)
        if part not in known:
            more = validation.options_of(node) if isinstance(node, dict) else set()
            names = {name for name in known if name[0] != "_"} - {"hydra"} | more
            if part in more or not names:
                return None
            return f"{key}: there is no such key; {validation.suggestion(part, names, place)}"
        node, place = known[part], f"{place}{part}."
    return None


def _below(node: Any) -> dict[str, Any]:
    """Return the entries of a node by name or number."""
    if isinstance(node, list):
        node = dict(enumerate(node))
    return {str(key): one for key, one in node.items()} if isinstance(node, dict) else {}

"""The text of `--help`: groups and keys of a command with the comments of its YAML files."""

import shutil
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from dpl.commands import overrides
from dpl.config import comments
from dpl.config.validation import HYDRA_KEYS

WIDTH = 100  # columns at most
COLUMN = 40  # where comments begin
FLAGS = {
    "-m": "run a job for each combination of values: -m loss=mse,lr_star seed=0,1",
    "--cfg job": "print the whole configuration and exit",
    "--config-dir DIR": "also search DIR for options of groups",
    "--hydra-help": "print the other flags, which are those of Hydra",
}


def page(name: str, about: str, lines: Sequence[str]) -> str:
    """Return the help of a command, see `dpl.commands.overrides` for Hydra's state.

    Args:
        name: Name of the command's configuration.
        about: Docstring of the command's module.
        lines: Overrides. The keys are those of the chosen options.

    Raises:
        ConfigError: An override cannot be applied.
    """
    single = [line for line in lines if not overrides.parsed(line).is_sweep_override()]
    cfg = overrides.composed(name, single)
    heads, of_keys = _comments(name, single, cfg)
    chosen = {k: v for k, v in cfg.hydra.runtime.choices.items() if not k.startswith("hydra")}
    text = about.splitlines()
    if chosen:
        text += ["", "GROUP=OPTION chooses an option of a group; * is chosen:", ""]
    for group, option in sorted(chosen.items()):
        known = overrides.options(name, group)
        names = ", ".join(f"{one}*" if one == option else one for one in known)
        comment = of_keys.get(f"defaults.{group}")
        text += _entry(group, f"{comment}: {names}" if comment else names)
    text += ["", "KEY=VALUE changes a value, +KEY=VALUE adds one, ~KEY removes one:", ""]
    values = cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=False))
    del values["hydra"]
    for key, value in sorted(values.items(), key=lambda item: item[0] in heads):
        if key in heads:
            call = f" ({value['_target_']})" if "_target_" in value else ""
            text += ["", *_wrapped(f"{key}={chosen[key]}{call}: {heads[key]}", "", "  ")]
        for place, one in _leaves(key, value):
            owner = place.removesuffix("._target_")
            text += _entry(f"{place} = {one}", of_keys.get(place) or of_keys.get(owner, ""))
    text += ["", "Flags:", ""]
    for flag, does in FLAGS.items():
        text += _entry(flag, does)
    return "\n".join(text)


def _comments(
    name: str, lines: list[str], cfg: DictConfig
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the comments of the chosen options by group, and those of keys."""
    sources = cfg.hydra.runtime.config_sources
    folders = [Path(one.path) for one in sources if one.schema == "file"]
    heads: dict[str, str] = {}
    of_keys: dict[str, str] = {}
    for part in overrides.defaults(name, lines):  # later ones overwrite earlier ones
        paths = (folder / f"{part.config_path}.yaml" for folder in folders)
        if path := next(filter(Path.is_file, paths), None):
            head, found = comments.read(path.read_text(encoding="utf-8"))
            prefix = f"{part.package}." if part.package else ""
            heads[str(part.config_path).rpartition("/")[0]] = head
            of_keys |= {prefix + key: comment for key, comment in found.items()}
    return heads, of_keys


def _leaves(path: str, node: Any) -> Iterator[tuple[str, str]]:
    """Yield the keys of values below a node, and the values as text."""
    if not isinstance(node, dict) or not node:
        yield path, _text(node)
        return
    for key, value in node.items():
        if key not in HYDRA_KEYS or (key == "_target_" and "." in path):
            yield from _leaves(f"{path}.{key}", value)


def _text(value: Any) -> str:
    """Return a value as written on the command line."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {_text(one)}' for key, one in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, float):
        return f"{value:g}"
    return {"None": "null", "True": "true", "False": "false", "": "''"}.get(str(value), str(value))


def _entry(left: str, comment: str) -> list[str]:
    """Return the lines of one entry: a key and, from `COLUMN` on, its comment."""
    if len(left) > COLUMN - 4:
        lines = _wrapped(left, "  ", "      ")
        return lines + (_wrapped(comment, " " * COLUMN, " " * COLUMN) if comment else [])
    return _wrapped(comment, f"  {left:{COLUMN - 2}}", " " * COLUMN) or [f"  {left}"]


def _wrapped(text: str, first: str, other: str) -> list[str]:
    width = min(WIDTH, shutil.get_terminal_size((WIDTH, 24)).columns)
    return textwrap.wrap(
        text, width, initial_indent=first, subsequent_indent=other, break_on_hyphens=False
    )

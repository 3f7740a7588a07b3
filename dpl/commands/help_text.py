"""The text of `--help`: groups and keys of a command with the comments of its YAML files."""

import shutil
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

from omegaconf import OmegaConf

from dpl.commands import dry_run, overrides
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


def page(name: str, conf: Path, about: str, arguments: Sequence[str]) -> str:
    """Return the help of a command line.

    Args:
        name: Name of the command's configuration.
        conf: Folder of the configurations.
        about: Docstring of the command's module.
        arguments: Command line. The keys are those of the chosen options.

    Raises:
        ConfigError: An override cannot be applied.
    """
    args = dry_run.arguments_of(arguments)
    with dry_run.initialized(args.config_path or conf, args.config_dir):
        single = [one for one in args.overrides if not overrides.parsed(one).is_sweep_override()]
        cfg = overrides.composed(name, single)
        chosen = {str(group): cfg.hydra.runtime.choices[group] for group in _groups(cfg)}
        options = {group: overrides.options(group) for group in chosen}
        files = _files(name, chosen, overrides.folders())
    told = {row.key: row.comment for file in files for row in file.rows if row.comment}
    groups = {group: text for file in files for group, text in file.groups.items()}
    lines = about.splitlines()
    if chosen:
        lines += ["", "GROUP=OPTION chooses an option of a group; * is chosen:", ""]
    for group, option in sorted(chosen.items()):
        names = ", ".join(f"{one}*" if one == option else one for one in options[group])
        lines += _entry(group, f"{groups[group]}: {names}" if group in groups else names)
    lines += ["", "KEY=VALUE changes a value, +KEY=VALUE adds one, ~KEY removes one:", ""]
    heads = {file.path.parent.as_posix(): file for file in files}
    values = cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=False))
    del values["hydra"]
    for key, value in sorted(values.items(), key=lambda item: item[0] in heads):
        if key in heads:
            call = f" ({value['_target_']})" if "_target_" in value else ""
            lines += ["", *_wrapped(f"{key}={chosen[key]}{call}: {heads[key].about}", "", "  ")]
        for place, one in _leaves(key, value):
            owner = place.removesuffix("._target_")
            lines += _entry(f"{place} = {one}", told.get(place) or told.get(owner, ""))
    lines += ["", "Flags:", ""]
    for flag, does in FLAGS.items():
        lines += _entry(flag, does)
    return "\n".join(lines)


def _groups(cfg: Any) -> list[str]:
    """Return the groups of a command, without those of Hydra."""
    return [group for group in cfg.hydra.runtime.choices if not group.startswith("hydra")]


def _files(name: str, chosen: dict[str, Any], folders: Sequence[Path]) -> list[comments.ConfigFile]:
    """Return the files that a configuration is composed of; later ones overwrite earlier ones."""
    found: list[comments.ConfigFile] = []

    def add(path: str) -> None:
        folder = next((one for one in folders if (one / f"{path}.yaml").is_file()), None)
        if folder is None:
            return
        file = comments.read(folder / f"{path}.yaml", folder)
        for default in file.defaults:
            if ":" not in default and default != "_self_":
                add((Path(path).parent / default).as_posix())
        found.append(file)

    add(name)
    for group, options in chosen.items():
        for option in options if isinstance(options, list) else [options]:
            add(f"{group}/{option}")
    return found


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
        inner = (f"{key}: {_text(one)}" for key, one in value.items())
        return f"{{{', '.join(inner)}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_text, value))}]"
    words = {None: "null", True: "true", False: "false", "": "''"}
    if value is None or isinstance(value, bool | str):
        return words.get(value, str(value))
    return f"{value:g}" if isinstance(value, float) else str(value)


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

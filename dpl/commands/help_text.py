"""The text of `--help`: groups with their options, and the YAML files of a command."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

from dpl.commands import overrides

WIDTH = 100  # columns
FLAGS = """
Flags:

  -m                run a job for each combination of values: -m loss=mse,lr_star seed=0,1
  --cfg job         print the whole configuration with the values of this command line and exit
  --config-dir DIR  also search DIR for options of groups
  --hydra-help      print the other flags, which are those of Hydra"""


def page(name: str, about: str, lines: Sequence[str]) -> str:
    """Return the help of a command, see `dpl.commands.overrides` for Hydra's state.

    Args:
        name: Name of the command's configuration.
        about: Docstring of the command's module.
        lines: Overrides. The files are those of the chosen options.

    Raises:
        ConfigError: An override cannot be applied.
    """
    single = [line for line in lines if not overrides.parsed(line).is_sweep_override()]
    cfg = overrides.composed(name, single)
    chosen = {k: v for k, v in cfg.hydra.runtime.choices.items() if not k.startswith("hydra")}
    text = [*about.splitlines()]
    if chosen:
        text += ["", "GROUP=OPTION chooses an option of a group; * is chosen:", ""]
    for group, option in sorted(chosen.items()):
        names = (f"{one}*" if one == option else one for one in overrides.options(name, group))
        text += textwrap.wrap(
            f"{group:14} {', '.join(names)}", WIDTH, initial_indent="  ",
            subsequent_indent=" " * 17, break_on_hyphens=False,
        )  # fmt: skip
    text += ["", "KEY=VALUE changes a value, +KEY=VALUE adds one, ~KEY removes one."]
    folders = [Path(s.path) for s in cfg.hydra.runtime.config_sources if s.schema == "file"]
    for part in overrides.defaults(name, single):
        paths = (folder / f"{part.config_path}.yaml" for folder in folders)
        if path := next(filter(Path.is_file, paths), None):
            place = f"keys of {part.package}" if part.package else "keys"
            text += ["", f"{place}, {part.config_path}.yaml:", ""]
            text += textwrap.indent(path.read_text(encoding="utf-8").rstrip(), "  ").splitlines()
    return "\n".join([*text, *FLAGS.splitlines()])

"""Keys, values and comments of the YAML files of a configuration."""

import re
from dataclasses import dataclass, field
from pathlib import Path

import yaml


@dataclass(frozen=True)
class Row:
    """One key of a file.

    Attributes:
        key: Full key, as on the command line.
        default: Value as written in the file, "" for a mapping.
        comment: Comment at the end of its line and on the comment lines below.
    """

    key: str
    default: str
    comment: str


@dataclass(frozen=True)
class ConfigFile:
    """One YAML file.

    Attributes:
        path: Path relative to the folder of the configuration.
        about: Comment at the head of the file.
        defaults: Entries of the defaults list.
        groups: Comments of the defaults list by group.
        rows: Keys.
        calls: Names of the called classes and functions by key.
    """

    path: Path
    about: str
    defaults: list[str] = field(default_factory=list)
    groups: dict[str, str] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)
    calls: dict[str, str] = field(default_factory=dict)


def read(path: Path, conf: Path) -> ConfigFile:
    """Return the keys and comments of a file.

    Args:
        path: The file.
        conf: Folder of the configuration. A file in a subfolder sets the keys of that group, unless
            its head is `# @package _global_`.
    """
    text = path.read_text(encoding="utf-8")
    head = re.match(r"(#.*\n)*", text)[0].splitlines()  # type: ignore[index]
    lines = [line.lstrip("# ").rstrip() for line in head]
    relative = path.relative_to(conf)
    is_global = any(line.startswith("@package _global_") for line in lines)
    prefix = "" if is_global else "".join(f"{part}." for part in relative.parts[:-1])
    found = ConfigFile(relative, " ".join(line for line in lines if line[:1] != "@"))
    root = yaml.compose(text)
    for key, value in [] if root is None else root.value:
        if key.value == "defaults":
            for entry in value.value:
                _add_default(entry, text, found)
        else:
            _add_rows(prefix + key.value, key, value, text, found.rows)
    for row in found.rows:
        owner, _, last = row.key.rpartition(".")
        if last == "_target_":
            found.calls[owner] = row.default
    return found


def _add_default(entry: yaml.Node, text: str, found: ConfigFile) -> None:
    """Add an entry of the defaults list."""
    if isinstance(entry, yaml.ScalarNode):
        found.defaults.append(str(entry.value))
        return
    for group, option in entry.value:
        found.defaults.append(f"{group.value}: {option.value}")
        if comment := _comment(text, option):
            found.groups[group.value] = comment


def _add_rows(path: str, key: yaml.Node, value: yaml.Node, text: str, rows: list[Row]) -> None:
    """Add the rows of a key and of all keys below it."""
    is_block = isinstance(value, yaml.MappingNode) and not value.flow_style
    comment = _comment(text, key if is_block else value)
    if isinstance(value, yaml.MappingNode) and value.value:
        if comment:
            rows.append(Row(path, "", comment))
        for name, node in value.value:
            _add_rows(f"{path}.{name.value}", name, node, text, rows)
        return
    if isinstance(value, yaml.SequenceNode) and not value.flow_style:
        for k, item in enumerate(value.value):
            _add_rows(f"{path}[{k}]", item, item, text, rows)
        return
    source = text[value.start_mark.index : value.end_mark.index]
    rows.append(Row(path, " ".join(source.split()), comment))


def _comment(text: str, node: yaml.Node) -> str:
    """Return the comment after a node and on the comment lines below it, "" without one."""
    rest, *below = text[node.end_mark.index :].split("\n")
    found = re.search(r"(?:^|[\s:])#\s*(.*)", rest)
    parts = [found[1]] if found else []
    for line in below:
        if not parts or not line.lstrip().startswith("#"):
            break
        parts.append(line.strip().lstrip("#").strip())
    return " ".join(parts)

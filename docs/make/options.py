"""The page of all options, from conf/: keys, defaults, comments, and what their calls take."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import griffe
import modules
import yaml
from paths import CONF, PACKAGE

GIVEN = {"self", "args", "kwargs"}


@dataclass(frozen=True)
class Row:
    """One key of a file.

    Attributes:
        key: As it is written on the command line.
        default: As it stands in the file.
        comment: What stands behind it.
    """

    key: str
    default: str
    comment: str


@dataclass(frozen=True)
class Option:
    """One file of conf/.

    Attributes:
        path: Relative to conf/.
        about: Comment at its beginning.
        composed: Entries of its defaults list.
        rows: Its keys.
        calls: Key to dotted name, of what it calls.
    """

    path: Path
    about: str
    composed: list[str]
    rows: list[Row]
    calls: dict[str, str]

    @property
    def group(self) -> str:
        """Its folder; none of what commands share."""
        return self.path.parent.name

    @property
    def title(self) -> str:
        """What chooses it: group=option."""
        return f"{self.group}={self.path.stem}"

    @property
    def anchor(self) -> str:
        """Where it stands in the page."""
        return "-".join(self.path.with_suffix("").parts)


def read(path: Path) -> Option:
    """Return a file of conf/."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    head = []
    for line in lines:
        if not line.startswith("#"):
            break
        head.append(line.lstrip("# ").rstrip())
    whole = any(line.startswith("@package _global_") for line in head)
    about = " ".join(line for line in head if not line.startswith("@package"))
    relative = path.relative_to(CONF if path.is_relative_to(CONF) else path.parent)
    prefix = "" if whole or len(relative.parts) == 1 else relative.parts[0]
    rows: list[Row] = []
    calls: dict[str, str] = {}
    composed: list[str] = []
    node = yaml.compose(text)
    if node is not None:
        for key, value in node.value:
            if key.value == "defaults":
                composed = [_entry(item) for item in value.value]
                rows.append(Row("defaults", ", ".join(composed), ""))
                continue
            _collect(f"{prefix}.{key.value}" if prefix else key.value, key, value, text, rows)
    for row in rows:
        owner, _, last = row.key.rpartition(".")
        if last == "_target_":
            calls[owner] = row.default
    return Option(relative, about, composed, rows, calls)


def _collect(path: str, key: yaml.Node, value: yaml.Node, text: str, rows: list[Row]) -> None:
    """Add the rows of a key and of all below it."""
    whole = isinstance(value, yaml.MappingNode) and not value.flow_style
    comment = _comment(text, key if whole else value)
    if isinstance(value, yaml.MappingNode) and value.value:
        if comment:
            rows.append(Row(path, "", comment))
        for below, node in value.value:
            _collect(f"{path}.{below.value}", below, node, text, rows)
    elif isinstance(value, yaml.SequenceNode) and any(
        isinstance(item, yaml.MappingNode) for item in value.value
    ):
        for k, item in enumerate(value.value):
            for below, node in item.value:
                _collect(f"{path}[{k}].{below.value}", below, node, text, rows)
    else:
        rows.append(Row(path, _source(value, text), comment))


def _entry(item: yaml.Node) -> str:
    """Return an entry of a defaults list."""
    if isinstance(item, yaml.ScalarNode):
        return str(item.value)
    return ", ".join(f"{key.value}: {chosen.value}" for key, chosen in item.value)


def _source(node: yaml.Node, text: str) -> str:
    return " ".join(text[node.start_mark.index : node.end_mark.index].split())


def _comment(text: str, node: yaml.Node) -> str:
    """Return the comment behind a node and on the lines of comment that follow."""
    behind, *below = text[node.end_mark.index :].split("\n")
    found = re.search(r"(?:^|[\s:])#\s*(.*)", behind)
    parts = [found[1]] if found else []
    for line in below:
        if not parts or not line.lstrip().startswith("#"):
            break
        parts.append(line.strip().lstrip("#").strip())
    return " ".join(parts)


def options() -> list[Option]:
    """Return all files in groups."""
    return [read(path) for path in sorted(CONF.glob("*/*.yaml"))]


def shared() -> list[Option]:
    """Return the files that commands are composed of and that are no command's own."""
    return [
        read(path)
        for path in sorted(CONF.glob("*.yaml"))
        if not (PACKAGE / "commands" / f"{path.stem}.py").is_file()
    ]


def page() -> str:
    """Return the page."""
    groups: dict[str, list[Option]] = {}
    for option in options():
        groups.setdefault(option.group, []).append(option)
    parts = [
        "# Options\n",
        "Every file of `conf/`, read when this page was made. An option of a group is chosen by "
        "`group=option`, a key of it changed by `group.key=value`; what Python alone defaults, and "
        "the file leaves out, wants a plus: `+mesh.cell=tetra`. `???` has to be given. Keys of "
        "whole commands are on the page of [commands](commands.md).\n",
        "| group | options |",
        "| --- | --- |",
    ]
    for group, members in groups.items():
        links = ", ".join(f"[{one.path.stem}](#{one.anchor})" for one in members)
        parts.append(f"| [{group}](#group-{group}) | {links} |")
    for option in shared():
        parts.append(f"\n## Keys of every {option.path.stem} {{ #{option.anchor} }}\n")
        parts += body(option)
    for group, members in groups.items():
        parts.append(f"\n## {group} {{ #group-{group} }}\n")
        for option in members:
            parts.append(f"\n### `{option.title}` {{ #{option.anchor} }}\n")
            parts += body(option)
    return "\n".join(parts) + "\n"


def body(option: Option) -> Iterator[str]:
    """Yield the lines of one file."""
    yield f"{code_links(option.about)}\n"
    yield from table(option.rows, option.calls)
    for key, target in option.calls.items():
        yield from _defaulted(option, key, target)


def code_links(text: str) -> str:
    """Return a comment, its stars and bars harmless."""
    return text.replace("|", "\\|").replace("*", "\\*").replace("<", "&lt;").replace("_", "\\_")


def table(rows: list[Row], calls: dict[str, str]) -> Iterator[str]:
    """Yield the table of keys."""
    if not rows:
        return
    yield "| key | default | |"
    yield "| --- | --- | --- |"
    for row in rows:
        owner, _, last = row.key.rpartition(".")
        told = code_links(row.comment)
        if owner in calls and last not in ("_target_", "_partial_"):
            known = parameters(calls[owner]).get(last)
            if known is not None and known.about:
                new = told.lower() not in known.about.lower()
                told = f"{told}. {known.about}" if told and new else known.about
        default = f"`{row.default}`".replace("|", "\\|") if row.default else ""
        yield f"| `{row.key}` | {default} | {told} |"
    yield ""


@dataclass(frozen=True)
class Parameter:
    """What a call takes: its default (None: it must be given) and what the docstring says."""

    default: str | None
    about: str


def parameters(target: str) -> dict[str, Parameter]:
    """Return what a call of this package takes, by name; {} for those of others."""
    found = modules.find(target)
    if found is None:
        return {}
    about: dict[str, str] = {}
    owners = [*reversed(found.mro()), found] if isinstance(found, griffe.Class) else [found]
    for owner in owners:
        init = owner.members.get("__init__") if owner.is_class else None
        for place in (owner, init):
            if place is None or place.docstring is None:
                continue
            for part in place.docstring.parse("google", warnings=False):
                if part.kind.value in ("attributes", "parameters"):
                    for item in part.value:
                        told = " ".join(item.description.split())
                        about |= {name.strip(): told for name in item.name.split(",")}
    return {
        one.name: Parameter(
            None if one.default is None else str(one.default),
            about.get(one.name, "").replace("|", "\\|"),
        )
        for one in _signature(found)
        if one.name not in GIVEN
    }


def _signature(found: griffe.Object) -> list[griffe.Parameter]:
    """Return the parameters; of a class those of the nearest constructor."""
    if isinstance(found, griffe.Function):
        return list(found.parameters)
    if not isinstance(found, griffe.Class):
        return []
    for owner in (found, *found.mro()):
        if "__init__" in owner.members:
            return list(owner.members["__init__"].parameters)
    return list(found.parameters)


def _defaulted(option: Option, key: str, target: str) -> Iterator[str]:
    """Yield what Python defaults and the file leaves out."""
    start = f"{key}." if key else ""
    written = {row.key.removeprefix(start).split(".")[0].split("[")[0] for row in option.rows}
    rest = {name: one for name, one in parameters(target).items() if name not in written}
    given = [name for name, one in rest.items() if one.default is None]
    more = {name: one for name, one in rest.items() if one.default is not None}
    if more:
        yield f'??? note "More that `{target.rpartition(".")[2]}` takes"\n'
        yield "    | key | default | |"
        yield "    | --- | --- | --- |"
        for name, one in more.items():
            default = one.default.replace("|", "\\|")
            yield f"    | `+{start}{name}` | `{default}` | {one.about} |"
        yield ""
    if given:
        yield f"Given by the command: {', '.join(f'`{name}`' for name in given)}.\n"

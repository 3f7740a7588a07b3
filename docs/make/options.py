"""The page of all options, from conf/: keys, defaults, comments, and what their calls take."""

from collections.abc import Iterator
from dataclasses import dataclass

import griffe
import modules
from paths import CONF, PACKAGE

from dpl.config.comments import ConfigFile, Row, read

GIVEN = {"self", "args", "kwargs"}


def title(file: ConfigFile) -> str:
    """Return what chooses a file: group=option."""
    return f"{file.path.parent.name}={file.path.stem}"


def anchor(file: ConfigFile) -> str:
    """Return the anchor of a file in the page."""
    return "-".join(file.path.with_suffix("").parts)


def options() -> list[ConfigFile]:
    """Return all files in groups."""
    return [read(path, CONF) for path in sorted(CONF.glob("*/*.yaml"))]


def shared() -> list[ConfigFile]:
    """Return the files that commands are composed of and that are no command's own."""
    return [
        read(path, CONF)
        for path in sorted(CONF.glob("*.yaml"))
        if not (PACKAGE / "commands" / f"{path.stem}.py").is_file()
    ]


def page() -> str:
    """Return the page."""
    groups: dict[str, list[ConfigFile]] = {}
    for option in options():
        groups.setdefault(option.path.parent.name, []).append(option)
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
        links = ", ".join(f"[{one.path.stem}](#{anchor(one)})" for one in members)
        parts.append(f"| [{group}](#group-{group}) | {links} |")
    for option in shared():
        parts.append(f"\n## Keys of every {option.path.stem} {{ #{anchor(option)} }}\n")
        parts += body(option)
    for group, members in groups.items():
        parts.append(f"\n## {group} {{ #group-{group} }}\n")
        for option in members:
            parts.append(f"\n### `{title(option)}` {{ #{anchor(option)} }}\n")
            parts += body(option)
    return "\n".join(parts) + "\n"


def body(option: ConfigFile) -> Iterator[str]:
    """Yield the lines of one file."""
    yield f"{code_links(option.about)}\n"
    if option.defaults:
        yield f"Defaults: {', '.join(f'`{entry}`' for entry in option.defaults)}.\n"
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


def _defaulted(option: ConfigFile, key: str, target: str) -> Iterator[str]:
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

"""Pages of the public modules, and what can be linked to by name."""

import functools
from collections.abc import Iterator
from pathlib import Path

import griffe
from paths import PACKAGE, ROOT

TOP = "dpl"


def names() -> list[str]:
    """Return the public modules, dotted, packages before what is in them."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        name = ".".join(parts)
        if any(part.startswith("_") for part in parts):
            continue
        found.append(name)
    return sorted(found)


def page(name: str) -> str:
    """Return the path of the page of a module in the site."""
    return f"api/{'index' if name == TOP else name.removeprefix('dpl.')}.md"


def packages() -> dict[str, list[str]]:
    """Return for each package the modules directly in it."""
    inside: dict[str, list[str]] = {TOP: []}
    for name in names():
        if (PACKAGE.parent / Path(*name.split("."))).is_dir():
            inside.setdefault(name, [])
        if name != TOP:
            inside.setdefault(name.rpartition(".")[0], []).append(name)
    return inside


def pages() -> Iterator[tuple[str, str]]:
    """Yield paths and texts of the pages."""
    inside = packages()
    for name in names():
        text = f"::: {name}\n"
        if name in inside:
            text += "    options: {members: false}\n" if name != TOP else ""
            text += "\n" + "\n".join(
                ["| module | |", "| --- | --- |"]
                + [f"| [`{one}`][{one}] | {summary(one)} |" for one in _below(name, inside)]
            )
            text += "\n"
        yield page(name), text


def _below(name: str, inside: dict[str, list[str]]) -> Iterator[str]:
    """Yield the modules in a package; for the whole of it, in its packages too."""
    for one in inside[name]:
        yield one
        if name == TOP and one in inside:
            yield from inside[one]


def nav() -> list:
    """Return the navigation of these pages."""
    inside = packages()
    alone = [{one: page(one)} for one in inside[TOP] if one not in inside]
    rooms = [
        {name: [page(name), *({one.rpartition(".")[2]: page(one)} for one in found)]}
        for name, found in inside.items()
        if name != TOP
    ]
    return [page(TOP), *alone, *rooms]


@functools.cache
def package() -> griffe.Module:
    """Return the package, read and not imported."""
    loaded = griffe.load(TOP, search_paths=[str(ROOT)], docstring_parser="google")
    assert isinstance(loaded, griffe.Module)
    return loaded


def find(name: str) -> griffe.Object | None:
    """Return what a dotted name of the package stands for; None if there is nothing."""
    if not name.startswith("dpl."):
        return None
    try:
        found = package()[name.removeprefix("dpl.")]
        return found.final_target if found.is_alias else found
    except (KeyError, griffe.GriffeError):
        return None


def summary(name: str) -> str:
    """Return the first line of the docstring of a name."""
    found = package() if name == TOP else find(name)
    if found is None or found.docstring is None:
        return ""
    return found.docstring.value.split("\n")[0].replace("|", "\\|")


def anchor(name: str) -> str | None:
    """Return under which name a dotted name can be linked to; None if it cannot."""
    if name in linkable():
        return name
    found = find(name)
    return found.path if found is not None and found.path in linkable() else None


@functools.cache
def linkable() -> frozenset[str]:
    """Return the dotted names that pages of modules have an anchor for."""
    found = set(names())

    def collect(owner: griffe.Object) -> None:
        for member in owner.members.values():
            if member.is_alias or member.name.startswith("_") or member.docstring is None:
                continue
            if member.is_class or member.is_function:
                found.add(member.path)
            if member.is_class:
                collect(member)

    for name in names():
        module = package() if name == TOP else find(name)
        if module is not None:
            collect(module)
    return frozenset(found)

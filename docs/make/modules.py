"""Reference pages: one per folder of the package, with the names that its `__init__.py` exports.

Each page begins with a table of its names. A name that several folders export is on the page of the
outermost one alone: the names of the package first, then those of its folders.
"""

import functools
from collections.abc import Iterator

import griffe
from paths import ROOT

TOP = "dpl"


@functools.cache
def package() -> griffe.Module:
    """Return the package, parsed and not imported."""
    loaded = griffe.load(TOP, search_paths=[str(ROOT)], docstring_parser="google")
    assert isinstance(loaded, griffe.Module)
    return loaded


@functools.cache
def exports() -> dict[str, dict[str, str]]:
    """Return for each folder its public names with the path of their definition.

    The package comes first, then its folders, then the folders in these. Public names are those
    that `__init__.py` imports under `if TYPE_CHECKING:`.
    """
    found: dict[str, dict[str, str]] = {}

    def collect(folder: griffe.Module) -> None:
        names = {
            member.name: member.final_target.path
            for member in folder.members.values()
            if member.is_alias and not member.runtime and member.target_path.startswith(f"{TOP}.")
        }
        if names:
            found[folder.path] = dict(sorted(names.items()))
        for module in sorted(folder.modules.values(), key=lambda one: one.name):
            if not module.is_alias:  # `import dpl` in a module leads back to the package
                collect(module)

    collect(package())
    return dict(sorted(found.items(), key=lambda item: item[0].count(".")))


@functools.cache
def documented() -> dict[str, str]:
    """Return for the path of each public definition the name under which it is documented."""
    found: dict[str, str] = {}
    for folder, own in exports().items():
        for name, path in own.items():
            found.setdefault(path, f"{folder}.{name}")
    return found


def page(folder: str) -> str:
    """Return the path of the page of a folder in the site."""
    return f"api/{folder}.md"


def pages() -> Iterator[tuple[str, str]]:
    """Yield paths and texts of the pages."""
    for folder, own in exports().items():
        names = {f"{folder}.{name}": path for name, path in own.items()}
        text = [f"::: {folder}", "    options: {members: false}", "", "| name | |", "| --- | --- |"]
        here = {name: path for name, path in names.items() if documented()[path] == name}
        for name, path in here.items():
            text.append(f"| [`{name}`][{name}] | {summary(path)} |")
        for name in here:
            text += ["", f"::: {name}", "    options: {heading_level: 2}"]
        yield page(folder), "\n".join(text) + "\n"


def find(name: str) -> griffe.Object | None:
    """Return the object of a dotted name of the package; None if there is none."""
    try:
        found = package()[name.removeprefix(f"{TOP}.")]
        return found.final_target if found.is_alias else found
    except (KeyError, griffe.GriffeError):
        return None


def summary(name: str) -> str:
    """Return the first line of a docstring."""
    found = find(name)
    docstring = found.docstring.value if found is not None and found.docstring else ""
    return docstring.split("\n")[0].replace("|", "\\|")


def anchor(name: str) -> str | None:
    """Return the anchor of a dotted name in the reference; None if it has none."""
    if name in exports():
        return name
    found = find(name)
    if found is None:
        return None
    if found.path in documented():
        return documented()[found.path]
    owner = found.parent
    inside = owner is not None and owner.is_class and owner.path in documented()
    if not inside or not found.is_function or not found.docstring or found.name.startswith("_"):
        return None
    return f"{documented()[owner.path]}.{found.name}"

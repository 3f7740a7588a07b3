"""The page of commands and options: docstrings of dpl/commands/, and the files of conf/.

Names of objects in the files become links to the reference.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from paths import CONF, PACKAGE

COMMAND = re.compile(r'^@(?:cli\.)?command\("(\w+)"', re.M)  # with the stem of its configuration
TARGET = re.compile(r"_target_: (dpl(?:\.\w+)+)")
HEAD = """# Commands and options

In a checkout a command is `python scripts/NAME.py key=value ...`, of the installed package
`dpl-NAME key=value ...`. `--help` prints the keys, `--cfg job` the whole configuration, and `-m`
runs a sweep over lists of values. Invalid input ends a command with one line and status 2, Ctrl-C
with status 130. [Contributing](contributing.md#measurements) lists the commands that measure this
repository.

`group=option` selects a file of `conf/`, `group.key=value` changes one of its keys. `???` marks a
key without a default. The reference of the objects below a file lists the arguments that the file
leaves out; they take a plus: `+mesh.cell=tetra`.

| | |
| --- | --- |"""


def anchor(path: Path) -> str:
    """Return the anchor of a file of conf/."""
    return "-".join(path.relative_to(CONF).with_suffix("").parts)


def commands() -> Iterator[tuple[str, str, Path]]:
    """Yield names, docstrings and configurations of the commands of the package."""
    for path in sorted((PACKAGE / "commands").glob("[a-z]*.py")):
        text = path.read_text(encoding="utf-8")
        if found := COMMAND.search(text):
            about = ast.get_docstring(ast.parse(text)) or ""
            yield path.stem, about.replace("*", "\\*"), CONF / f"{found[1]}.yaml"


def page() -> str:
    """Return the page."""
    groups: dict[str, list[Path]] = {}
    for path in sorted(CONF.glob("*/*.yaml")):
        groups.setdefault(path.parent.name, []).append(path)
    parts = [HEAD]
    for name, about, _ in commands():
        first = " ".join(about.partition("\n\n")[0].split())
        parts.append(f"| [`{name}`](#command-{name}) | {first} |")
    for group, members in groups.items():
        links = ", ".join(f"[{path.stem}](#{anchor(path)})" for path in members)
        parts.append(f"| [{group}](#group-{group}) | {links} |")
    for name, about, path in commands():
        parts += [f"\n## `{name}` {{ #command-{name} }}\n", f"{about}\n", *listing(path)]
    for path in sorted(CONF.glob("*.yaml")):
        if path not in {config for *_, config in commands()}:
            parts += [f"\n## Keys of every {path.stem} {{ #{anchor(path)} }}\n", *listing(path)]
    for group, members in groups.items():
        parts.append(f"\n## {group} {{ #group-{group} }}\n")
        for path in members:
            parts.append(f"\n### `{group}={path.stem}` {{ #{anchor(path)} }}\n")
            parts += listing(path)
    return "\n".join(parts) + "\n"


def listing(path: Path) -> Iterator[str]:
    """Yield a file as a block of code, and the names of its objects."""
    text = path.read_text(encoding="utf-8")
    yield f"```yaml\n{text.rstrip()}\n```\n"
    if targets := dict.fromkeys(TARGET.findall(text)):
        yield f"Objects: {', '.join(f'`{target}`' for target in targets)}\n"

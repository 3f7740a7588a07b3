"""The page of all options: the files of conf/ with links to the objects that they name."""

import re
from collections.abc import Iterator
from pathlib import Path

from paths import CONF, PACKAGE

TARGET = re.compile(r"_target_: (dpl(?:\.\w+)+)")
HEAD = """# Options

The files of `conf/`. `group=option` selects a file, `group.key=value` changes one of its keys.
`???` marks a key without a default. The reference of the objects below a file lists the arguments
that the file leaves out; they take a plus: `+mesh.cell=tetra`. [Commands](commands.md) lists the
keys of whole commands.

| group | options |
| --- | --- |"""


def anchor(path: Path) -> str:
    """Return the anchor of a file of conf/."""
    return "-".join(path.relative_to(CONF).with_suffix("").parts)


def page() -> str:
    """Return the page."""
    groups: dict[str, list[Path]] = {}
    for path in sorted(CONF.glob("*/*.yaml")):
        groups.setdefault(path.parent.name, []).append(path)
    parts = [HEAD]
    for group, members in groups.items():
        links = ", ".join(f"[{path.stem}](#{anchor(path)})" for path in members)
        parts.append(f"| [{group}](#group-{group}) | {links} |")
    for path in sorted(CONF.glob("*.yaml")):
        if not (PACKAGE / "commands" / path.name).with_suffix(".py").is_file():
            parts.append(f"\n## Keys of every {path.stem} {{ #{anchor(path)} }}\n")
            parts += listing(path)
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

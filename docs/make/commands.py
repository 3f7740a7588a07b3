"""The page of all commands, from their folders, conf/ and pyproject.toml."""

import ast
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import options
from paths import COMMANDS, ROOT

HEAD = """# Commands

In a checkout a command is `python scripts/NAME.py key=value ...`. The commands of `dpl/commands/`
are installed with the package as `dpl-NAME key=value ...`; those of `benchmarks/commands/` measure
this repository and are not installed. `--help` prints the keys, `--cfg job` the whole
configuration, and `-m` runs a sweep over lists of values. Invalid input ends a command with one
line and status 2, Ctrl-C with status 130.

| command | |
| --- | --- |"""


@dataclass(frozen=True)
class Command:
    """A module of dpl/commands/ or benchmarks/commands/.

    Attributes:
        name: Name of its script.
        about: Docstring of the module.
        does: Docstring of its main function.
        config: File of its configuration.
    """

    name: str
    about: str
    does: str
    config: Path


def commands() -> list[Command]:
    """Return all commands: modules with a function that `@command(name)` decorates."""
    found = []
    for path in sorted(path for folder in COMMANDS for path in folder.glob("[a-z]*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in tree.body:
            for mark in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
                if isinstance(mark, ast.Call) and ast.unparse(mark.func).endswith("command"):
                    config = COMMANDS[path.parent] / f"{mark.args[0].value}.yaml"
                    about, does = ast.get_docstring(tree) or "", ast.get_docstring(node) or ""
                    found.append(Command(path.stem, about, does, config))
    return found


def page() -> str:
    """Return the page."""
    found = commands()
    parts = [HEAD]
    for one in found:
        first = " ".join(one.about.split("\n\n")[0].split())
        parts.append(f"| [`{one.name}`](#{one.name}) | {escaped(first)} |")
    for one in found:
        parts += section(one)
    return "\n".join(parts) + "\n"


def section(one: Command) -> Iterator[str]:
    """Yield the lines of one command."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    installed = [k for k, v in project["scripts"].items() if v == f"dpl.commands.{one.name}:main"]
    yield f"\n## {one.name}\n"
    yield "```\n" + "\n".join([f"python scripts/{one.name}.py", *installed]) + "\n```\n"
    yield f"{escaped(one.about)}\n"
    yield f"{escaped(one.does)}\n"
    yield f"Configuration: `{one.config.relative_to(ROOT)}`.\n"
    yield from options.listing(one.config)


def escaped(text: str) -> str:
    """Return a docstring as Markdown that shows its stars, bars and underscores."""
    return text.replace("|", "\\|").replace("*", "\\*").replace("<", "&lt;").replace("_", "\\_")

"""The page of all commands, from their folders, conf/ and pyproject.toml."""

import ast
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass

import options
from paths import COMMANDS, CONF, ROOT


@dataclass(frozen=True)
class Command:
    """A module of dpl/commands/ or benchmarks/commands/.

    Attributes:
        name: Its script.
        about: Docstring of the module.
        does: Docstring of its main function.
        config: Path of its configuration in the repository.
    """

    name: str
    about: str
    does: str
    config: str


def commands() -> list[Command]:
    """Return all of them."""
    found = []
    for path in sorted(path for folder in COMMANDS for path in folder.glob("[a-z]*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in tree.body:
            if not isinstance(node, ast.FunctionDef):
                continue
            for mark in node.decorator_list:
                name = ast.unparse(mark.func) if isinstance(mark, ast.Call) else ""
                if name.rpartition(".")[2] == "command":
                    about, does = ast.get_docstring(tree) or "", ast.get_docstring(node) or ""
                    config = COMMANDS[path.parent] / f"{mark.args[0].value}.yaml"
                    where = config.relative_to(ROOT)
                    found.append(Command(path.stem, about, does, str(where)))
    return found


def page() -> str:
    """Return the page."""
    found = commands()
    parts = [
        "# Commands\n",
        "In a checkout a command is `python scripts/NAME.py key=value ...`. The commands of "
        "`dpl/commands/` are installed with the package as `dpl-NAME key=value ...`; those of "
        "`benchmarks/commands/` measure this repository and are not installed. "
        "`--help` prints its keys, `--cfg job` the whole configuration, `-m` makes a sweep of "
        "lists. Bad input ends with one line and status 2, Ctrl-C with 130.\n",
        "| command | |",
        "| --- | --- |",
    ]
    parts += [
        f"| [`{one.name}`](#{one.name}) | {options.code_links(_first(one.about))} |"
        for one in found
    ]
    for one in found:
        parts += section(one)
    return "\n".join(parts) + "\n"


def _first(text: str) -> str:
    return " ".join(text.split("\n\n")[0].split())


def section(one: Command) -> Iterator[str]:
    """Yield the lines of one command."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    doors = [
        name
        for name, target in scripts["project"]["scripts"].items()
        if target == f"dpl.commands.{one.name}:main"
    ]
    yield f"\n## {one.name}\n"
    yield "```\n" + "\n".join([f"python scripts/{one.name}.py", *doors]) + "\n```\n"
    yield f"{options.code_links(one.about)}\n"
    if one.does:
        yield f"{options.code_links(one.does)}\n"
    path = ROOT / one.config
    if not path.is_file():
        return
    config = options.read(path, path.parent)
    own = [row for row in config.rows if row.key != "defaults"]
    yield f"Configuration: `{one.config}`. {options.code_links(config.about)}\n"
    if config.defaults:
        yield f"Composed of {', '.join(_entry(entry) for entry in config.defaults)}.\n"
    yield from options.table(own, config.calls)


def _entry(entry: str) -> str:
    """Return an entry of a defaults list, linked to what it chooses."""
    group, _, chosen = entry.partition(":")
    group, chosen = group.split()[-1].lstrip("/"), chosen.strip()
    if not chosen:
        if not (CONF / f"{entry}.yaml").is_file():
            return f"`{entry}`"
        mine = any((folder / f"{entry}.py").is_file() for folder in COMMANDS)
        return f"[`{entry}`]({'' if mine else 'options.md'}#{entry})"
    if (CONF / group / f"{chosen}.yaml").is_file():
        return f"[`{entry}`](options.md#{group}-{chosen})"
    if (CONF / group).is_dir():
        return f"[`{entry}`](options.md#group-{group})"
    return f"`{entry}`"

"""Links between files of the repository as links between pages of the site."""

import os
import re
from collections.abc import Callable
from pathlib import PurePosixPath

from paths import DOCS, GENERATED, INCLUDED, NOTEBOOKS

LINK = re.compile(r"(?P<mark>!?)\[(?P<text>[^\]]*)\]\((?P<target>[^)\s]+)\)")
NAME = re.compile(r"(?<![\[`])`(?P<name>dpl(?:\.\w+)+)`(?![\]`])")
MADE = re.compile(r"(?P<linked><(?:autoref|a) [^>]*>)?<code>(?P<name>dpl(?:\.\w+)+)</code>")
ELSEWHERE = re.compile(r"[a-z]+:|#|//")
PLACES = {"conf": "options.md", "benchmarks": "measurements.md", "scripts": "options.md"}


def outside_code(text: str, change: Callable[[str], str]) -> str:
    """Return a text with `change` applied outside of fenced blocks."""
    parts = re.split(r"(^ *```.*?^ *``` *$)", text, flags=re.M | re.S)
    return "".join(part if k % 2 else change(part) for k, part in enumerate(parts))


def targets(text: str) -> list[str]:
    """Return the relative targets of a text's links and images, without anchors."""
    found: list[str] = []

    def collect(part: str) -> str:
        found.extend(
            match["target"].partition("#")[0]
            for match in LINK.finditer(part)
            if not ELSEWHERE.match(match["target"])
        )
        return part

    outside_code(text, collect)
    return found


def place(path: str) -> str | None:
    """Return the page or file of the site for a path of the repository; None if there is none."""
    for page, source in INCLUDED.items():
        if path == source:
            return page
    pure = PurePosixPath(path)
    if pure.parts[0] == "docs":
        inside = str(pure.relative_to("docs"))
        there = inside in GENERATED or inside in INCLUDED or (DOCS / inside).is_file()
        return inside if there else None
    if path.startswith("benchmarks/results/"):
        return path.removeprefix("benchmarks/")
    if pure.parts[0] == "notebooks":
        if pure.parent.name.endswith("_files"):  # figures, see `executed.pages`
            return path
        there = sorted(NOTEBOOKS.glob("*.ipynb"))
        named = [one for one in there if one.name == pure.name]
        first = there[:1] if pure.suffix != ".ipynb" else []
        return f"notebooks/{(named or first)[0].stem}.md" if named or first else None
    return PLACES.get(pure.parts[0])


def rewritten(text: str, source: str, page: str) -> str:
    """Return a text with its links rewritten for the site; links without a page become plain text.

    Args:
        text: Markdown.
        source: Path of its file in the repository.
        page: Path of its page in the site.
    """
    above, here = os.path.dirname(source), os.path.dirname(page) or "."

    def link(match: re.Match) -> str:
        target = match["target"]
        if ELSEWHERE.match(target):
            return match[0]
        path, hash_, anchor = target.partition("#")
        found = place(os.path.normpath(os.path.join(above, path)))
        if found is None:
            return match["text"]
        return f"{match['mark']}[{match['text']}]({os.path.relpath(found, here)}{hash_}{anchor})"

    return outside_code(text, lambda part: LINK.sub(link, part))


def named(text: str, anchor: Callable[[str], str | None]) -> str:
    """Return a text in which names of the package in backticks link to the reference.

    Args:
        text: Markdown.
        anchor: Returns the anchor of a dotted name, or None.
    """

    def link(match: re.Match) -> str:
        found = anchor(match["name"])
        return f"[{match[0]}][{found}]" if found else match[0]

    return outside_code(text, lambda part: NAME.sub(link, part))


def named_in_html(text: str, anchor: Callable[[str], str | None]) -> str:
    """Return HTML in which names of the package in `<code>` link to the reference."""

    def link(match: re.Match) -> str:
        found = None if match["linked"] else anchor(match["name"])
        return f'<autoref identifier="{found}">{match[0]}</autoref>' if found else match[0]

    return MADE.sub(link, text)

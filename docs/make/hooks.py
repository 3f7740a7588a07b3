"""What MkDocs calls while it makes the site: generated pages, links, formulas."""

from pathlib import Path
from typing import Any

import commands
import executed
import formulas
import links
import measured
import modules
import options
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from paths import CONF, DOCS, GENERATED, INCLUDED, NOTEBOOKS, PACKAGE, RESULTS, ROOT

HERE = Path(__file__).parent
MADE = dict(zip(GENERATED, (options.page, commands.page, measured.page), strict=True))


def on_config(config: MkDocsConfig) -> None:
    """Fill in the navigation what is there, and take out what is not."""
    config.nav = _there(config.nav)
    named = set(_leaves(config.nav))
    more = [path.name for path in sorted(DOCS.glob("*.md")) if path.name not in named]
    if more:
        config.nav.append({"More": more})
    config.watch += [str(path) for path in (CONF, PACKAGE, RESULTS, HERE)]


def _there(entries: list) -> list:
    """Return entries of a navigation without the pages that do not exist."""
    kept: list = []
    for entry in entries:
        title, target = next(iter(entry.items())) if isinstance(entry, dict) else (None, entry)
        if isinstance(target, list):
            target = _there(target)
        elif target == "api/":
            target = modules.nav()
        elif target == "notebooks/":
            target = [
                {executed.title(path): f"notebooks/{path.stem}.md"} for path in executed.paths()
            ]
        elif not _exists(target):
            continue
        if target:
            kept.append({title: target} if title else target)
    return kept


def _exists(page: str) -> bool:
    if page in INCLUDED:
        return (ROOT / INCLUDED[page]).is_file()
    return page in GENERATED or (DOCS / page).is_file()


def _leaves(entries: list) -> list[str]:
    found: list[str] = []
    for entry in entries:
        target = next(iter(entry.values())) if isinstance(entry, dict) else entry
        found += _leaves(target) if isinstance(target, list) else [target]
    return found


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add what is generated."""

    def add(path: str, content: str | bytes) -> None:
        files.append(File.generated(config, path, content=content))

    for page, make in MADE.items():
        add(page, make())
    for page, source in INCLUDED.items():
        if (ROOT / source).is_file():
            add(page, (ROOT / source).read_text(encoding="utf-8"))
    for path, content in modules.pages():
        add(path, content)
    for path, content in executed.pages(execute=bool(config.extra["notebooks"])):
        add(path, content)
    for path in measured.files():
        add(f"results/{path.name}", path.read_bytes())
    for name in ("style.css", "favicon.svg"):
        add(name, (HERE / name).read_bytes())


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Let links lead to pages, names of the package to their docstrings; fill in numbers."""
    path = page.file.src_uri
    if path in INCLUDED:
        markdown = links.rewritten(markdown, INCLUDED[path], path)
    elif (DOCS / path).is_file():
        markdown = links.rewritten(measured.filled(markdown), f"docs/{path}", path)
    elif path.startswith("notebooks/"):
        source = (NOTEBOOKS / path.removeprefix("notebooks/")).with_suffix(".ipynb")
        markdown = links.rewritten(markdown, str(source.relative_to(ROOT)), path)
    if path.startswith("api/"):
        return markdown
    return links.named(markdown, modules.anchor)


def on_page_content(html: str, page: Page, **_: Any) -> str:
    """Draw the formulas; let names in docstrings lead to theirs."""
    if page.file.src_uri.startswith("api/"):
        return links.named_in_html(html, modules.anchor)
    return formulas.mathml(html)


def on_post_build(config: MkDocsConfig) -> None:
    """Put the font of the formulas beside them."""
    site = Path(config.site_dir)
    pages = "".join(path.read_text(encoding="utf-8") for path in site.rglob("*.html"))
    (site / "math.woff").write_bytes(formulas.font(pages))

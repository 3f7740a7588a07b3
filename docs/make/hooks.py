"""Hooks of MkDocs: they add the generated pages, rewrite links and convert formulas."""

from pathlib import Path
from typing import Any

import executed
import formulas
import gallery
import links
import modules
import options
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from paths import CONF, DOCS, INCLUDED, NOTEBOOKS, PACKAGE, RESULTS, ROOT

HERE = Path(__file__).parent


def on_config(config: MkDocsConfig) -> None:
    """Fill in the reference and the notebooks; `mkdocs serve` builds again when sources change."""
    filled = {
        "api/": [{folder: modules.page(folder)} for folder in modules.exports()],
        "notebooks/": [
            {executed.title(path): f"notebooks/{path.stem}.md"} for path in executed.paths()
        ],
    }
    config.nav = _filled(config.nav, filled)
    config.watch += [str(path) for path in (CONF, NOTEBOOKS, PACKAGE, RESULTS, HERE)]


def _filled(entry: Any, filled: dict[str, list]) -> Any:
    if isinstance(entry, list):
        return [_filled(one, filled) for one in entry]
    if isinstance(entry, dict):
        return {title: _filled(target, filled) for title, target in entry.items()}
    return filled.get(entry, entry)


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages that are generated and the files that pages refer to."""

    def add(path: str, content: str | bytes) -> None:
        files.append(File.generated(config, path, content=content))

    add("options.md", options.page())
    for page, source in INCLUDED.items():
        add(page, (ROOT / source).read_text(encoding="utf-8"))
    for path, content in modules.pages():
        add(path, content)
    for path, content in executed.pages():
        add(path, content)
    for entry in gallery.entries():
        add(f"gallery/{entry.name}.py", entry.script)
    for path in sorted(RESULTS.iterdir()):
        add(f"results/{path.name}", path.read_bytes())
    for name in ("style.css", "favicon.svg", "iframe-worker.js"):
        add(name, (HERE / name).read_bytes())


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Rewrite links to files as links to pages, link names of the package."""
    path = page.file.src_uri
    if path.startswith("api/"):
        return markdown
    if path in INCLUDED:
        markdown = links.rewritten(markdown, INCLUDED[path], path)
    elif (DOCS / path).is_file():
        markdown = gallery.shown(markdown) if path == gallery.PAGE.name else markdown
        markdown = links.rewritten(markdown, f"docs/{path}", path)
    elif path.startswith("notebooks/"):
        source = (NOTEBOOKS / path.removeprefix("notebooks/")).with_suffix(".ipynb")
        markdown = links.rewritten(markdown, str(source.relative_to(ROOT)), path)
    return links.named(markdown, modules.anchor)


def on_page_content(html: str, page: Page, **_: Any) -> str:
    """Convert formulas; link names of the package in docstrings."""
    if page.file.src_uri.startswith("api/"):
        return links.named_in_html(html, modules.anchor)
    return formulas.mathml(html)


def on_post_build(config: MkDocsConfig) -> None:
    """Write the font of the formulas."""
    site = Path(config.site_dir)
    pages = "".join(path.read_text(encoding="utf-8") for path in site.rglob("*.html"))
    (site / "math.woff").write_bytes(formulas.font(pages))

"""Notebooks as pages, executed when the site is built.

Executed notebooks are cached in .cache/notebooks under a digest of the notebook, the package and
conf/. Pages of mkdocs-jupyter 0.26 name another host for their scripts; these pages have none.
"""

import hashlib
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from paths import CONF, NOTEBOOKS, PACKAGE, ROOT

CACHE = ROOT / ".cache" / "notebooks"
LONGEST = 1800  # seconds that a cell may take
ANSI = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def paths() -> list[Path]:
    """Return the paths of the notebooks."""
    return sorted(NOTEBOOKS.glob("*.ipynb"))


def title(path: Path) -> str:
    """Return the title of a notebook: its first heading, else its name."""
    import nbformat

    for cell in nbformat.read(path, as_version=4).cells:
        for line in cell.source.splitlines():
            if cell.cell_type == "markdown" and line.startswith("# "):
                return line.removeprefix("# ").strip()
    return path.stem.replace("_", " ")


def pages(*, execute: bool) -> Iterator[tuple[str, str | bytes]]:
    """Yield paths and contents of the pages and of their figures.

    Args:
        execute: Execute the notebooks; otherwise the pages have no outputs.

    Raises:
        PluginError: A cell fails.
    """
    import nbformat
    from nbconvert import MarkdownExporter

    for path in paths():
        notebook = run(path) if execute else nbformat.read(path, as_version=4)
        for cell in notebook.cells:
            for output in cell.get("outputs", []):
                if "text" in output:
                    output.text = ANSI.sub("", output.text)
        resources = {"output_files_dir": f"{path.stem}_files"}
        text, found = MarkdownExporter().from_notebook_node(notebook, resources=resources)
        yield f"notebooks/{path.stem}.md", text
        for name, content in found.get("outputs", {}).items():
            yield f"notebooks/{name}", content


def run(path: Path) -> Any:
    """Return a notebook with its outputs.

    Raises:
        PluginError: A cell fails.
    """
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    kept = CACHE / f"{path.stem}-{digest(path)}.ipynb"
    if kept.is_file():
        return nbformat.read(kept, as_version=4)
    notebook = nbformat.read(path, as_version=4)
    os.environ.setdefault("PYTHONPATH", str(ROOT))
    os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"  # figures as outputs
    with tempfile.TemporaryDirectory() as folder:
        work = {"metadata": {"path": folder}}
        client = NotebookClient(notebook, timeout=LONGEST, kernel_name="python3", resources=work)
        try:
            client.execute()
        except CellExecutionError as error:
            raise PluginError(f"{path.name}: {ANSI.sub('', str(error))}") from error
    CACHE.mkdir(parents=True, exist_ok=True)
    for old in CACHE.glob(f"{path.stem}-*.ipynb"):
        old.unlink()
    nbformat.write(notebook, kept)
    return notebook


def digest(path: Path) -> str:
    """Return a digest of everything that a notebook's outputs depend on."""
    found = hashlib.sha256()
    for one in [path, *sorted(PACKAGE.rglob("*.py")), *sorted(CONF.rglob("*.yaml"))]:
        found.update(one.read_bytes())
    return found.hexdigest()[:16]

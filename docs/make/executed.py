"""Notebooks with their outputs, as pages of the site.

`python docs/make/executed.py [NUMBER ...]`, a part of `make pictures`, executes the notebooks and
stores their outputs in them: figures as small PNG files, and printed text. Execution counts, memory
addresses, temporary folders and messages on stderr are left out, so that equal results give equal
files. The metadata contain the digest of the code; a test finds outputs of other code by it.

Pages of mkdocs-jupyter 0.26 name another host for their scripts; these pages have none.
"""

import base64
import hashlib
import io
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from paths import NOTEBOOKS, ROOT

COLOURS = 256  # of the palette of a picture
LONGEST = 1800  # seconds that a cell may take
ANSI = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
ADDRESS = re.compile(r" at 0x[0-9a-f]+>")
TEMPORARY = re.compile(re.escape(tempfile.gettempdir()) + r"/tmp\w+/?")
KEPT = ("text/markdown", "text/plain")  # kinds of output besides figures, the best first


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


def pages() -> Iterator[tuple[str, str | bytes]]:
    """Yield paths and contents of the pages and of their figures."""
    import nbformat
    from nbconvert import MarkdownExporter

    for path in paths():
        notebook = nbformat.read(path, as_version=4)
        resources = {"output_files_dir": f"{path.stem}_files"}
        text, found = MarkdownExporter().from_notebook_node(notebook, resources=resources)
        yield f"notebooks/{path.stem}.md", text
        for name, content in found.get("outputs", {}).items():
            yield f"notebooks/{name}", content


def code_digest(notebook: Any) -> str:
    """Return the SHA-256 of the code cells of a notebook, in hexadecimal."""
    code = "\0".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    return hashlib.sha256(code.encode()).hexdigest()


def execute(path: Path) -> None:
    """Execute a notebook and store its outputs in it.

    Raises:
        CellExecutionError: A cell fails.
    """
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        work = {"metadata": {"path": folder}}
        NotebookClient(notebook, timeout=LONGEST, kernel_name="python3", resources=work).execute()
    for cell in notebook.cells:
        cell.metadata = {}
        if cell.cell_type == "code":
            cell.execution_count = None
            kept = (reduced(output) for output in cell.outputs)
            cell.outputs = [output for output in kept if output is not None]
    notebook.metadata = {
        "code_sha256": code_digest(notebook),
        "kernelspec": notebook.metadata.kernelspec,
        "language_info": {"name": "python"},
    }
    nbformat.write(notebook, path)


def reduced(output: Any) -> Any:
    """Return the part of an output that is stored; None if there is none."""
    from nbformat import v4
    from PIL import Image

    if output.output_type == "stream":
        if output.name == "stderr":
            return None
        return v4.new_output("stream", name="stdout", text=portable(output.text))
    data = output.get("data", {})
    if "image/png" in data:
        with Image.open(io.BytesIO(base64.b64decode(data["image/png"]))) as image:
            drawn = base64.b64encode(_small_png(image)).decode()
        return v4.new_output("display_data", {"image/png": drawn})
    kind = next((kind for kind in KEPT if kind in data), None)
    if kind is None or not data[kind].strip() or ADDRESS.search(data[kind]):
        return None
    return v4.new_output("display_data", {kind: portable(data[kind])})


def _small_png(image: Any) -> bytes:
    """Return a picture of Pillow as PNG with a palette; transparent pixels become white."""
    from PIL import Image

    opaque = Image.new("RGBA", image.size, "white")
    opaque.alpha_composite(image.convert("RGBA"))
    method = Image.Quantize.MAXCOVERAGE  # keeps colours of small areas, such as ends of a scale
    drawn = opaque.convert("RGB").quantize(COLOURS, method, 2, dither=Image.Dither.NONE)
    made = io.BytesIO()
    drawn.save(made, "PNG", optimize=True)
    return made.getvalue()


def portable(text: str) -> str:
    """Return a text without escape sequences of terminals and without temporary folders."""
    return TEMPORARY.sub("", ANSI.sub("", text))


def main() -> None:
    """Execute the notebooks whose numbers are given, or all."""
    os.environ["PYTHONPATH"] = os.pathsep.join(
        filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])
    )
    os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"  # figures as outputs
    os.environ["OMP_NUM_THREADS"] = "1"
    for path in paths():
        if not sys.argv[1:] or path.name[0] in sys.argv[1:]:
            execute(path)
            print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()

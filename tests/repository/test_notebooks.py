"""Notebooks as a reader finds them: with their figures, and all of their code runs."""

import importlib
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
SECONDS = 300  # for one cell, where everything has to be compiled first

every = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def test_there_are_eight_and_the_index_names_each():
    index = (ROOT / "notebooks" / "README.md").read_text()
    assert [path.name[:2] for path in NOTEBOOKS] == [f"{k}_" for k in range(1, 9)]
    assert [path.name for path in NOTEBOOKS if f"({path.name})" not in index] == []


@pytest.fixture
def executed(monkeypatch):
    """The module that executes and stores notebooks."""
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "make"))
    return importlib.import_module("executed")


@every
def test_a_notebook_is_stored_with_the_outputs_of_its_code(path, executed):
    """`make pictures` stores them."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert (notebook.nbformat, notebook.nbformat_minor) == (4, 5)
    assert set(notebook.metadata) == {"code_sha256", "kernelspec", "language_info"}
    assert notebook.metadata.code_sha256 == executed.code_digest(notebook)
    assert 10 <= len(notebook.cells) <= 25
    assert notebook.cells[0].source.startswith("# ")
    for cell in notebook.cells:
        assert not cell.metadata
        if cell.cell_type == "code":
            assert cell.execution_count is None
            assert has_figure(cell) or "plt.subplots(" not in cell.source
            for output in cell.outputs:
                assert output == executed.reduced(output) or "image/png" in output.data


def has_figure(cell):
    """Whether a cell has a picture among its outputs."""
    return any("image/png" in output.get("data", {}) for output in cell.get("outputs", []))


def test_the_stored_figures_are_small():
    assert sum(path.stat().st_size for path in NOTEBOOKS) < 1.5e6


@every
def test_a_notebook_names_no_place_of_a_machine(path):
    text = path.read_text()
    assert (
        re.findall(r"(?<![\w.])/(?:home|tmp|work|root|usr|opt|mnt|Users)/|[A-Z]:\\\\", text) == []
    )


@every
def test_a_notebook_links_to_what_is_there(path):
    for target in re.findall(r"\]\(([^)#]+\.ipynb)\)", path.read_text()):
        assert (path.parent / target).is_file()


FIGURES = {"8_other_solvers": 2}  # fewest of a notebook; 5 of the others
# the one of the fewest laws, whose loops have to be compiled where no test has run before
QUICK = next(path for path in NOTEBOOKS if path.stem == "2_loads_and_data")


@pytest.mark.parametrize(
    "path",
    [path if path == QUICK else pytest.param(path, marks=pytest.mark.slow) for path in NOTEBOOKS],
    ids=lambda path: path.stem,
)
@pytest.mark.timeout(1200)
def test_a_notebook_runs_and_leaves_nothing_behind(path, tmp_path, monkeypatch, environment):
    """Its assertions hold; it draws, warns of nothing and works outside the repository.

    One takes about 20 s of processor time; the others are slow tests. `make pictures` executes all.
    """
    for name, value in environment().items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("MPLBACKEND")  # a kernel's own, which puts figures into the notebook
    before = _files()
    notebook = nbformat.read(path, as_version=4)
    place = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=SECONDS, kernel_name="python3", resources=place).execute()
    outputs = [out for cell in notebook.cells for out in cell.get("outputs", [])]
    stored = nbformat.read(path, as_version=4).cells
    assert [has_figure(cell) for cell in notebook.cells] == [has_figure(cell) for cell in stored]
    assert sum(has_figure(cell) for cell in stored) >= FIGURES.get(path.stem, 5)
    said = [out.text for out in outputs if out.get("name") == "stderr"]
    assert [text for text in said if "Warning" in text] == []
    assert list(tmp_path.iterdir()) == []
    assert _files() == before


def _files() -> set[Path]:
    """Return what lies beside the notebooks and at the top of the repository."""
    return {*(ROOT / "notebooks").rglob("*"), *ROOT.glob("[!.]*")}

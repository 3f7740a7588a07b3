"""The documentation is true: generated pages hold all there is, links lead on, code runs."""

import ast
import importlib
import io
import os
import re
import shlex
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import hydra
import matplotlib
import nbformat
import numpy as np
import pytest
import torch
import yaml
from hydra.core.global_hydra import GlobalHydra
from PIL import Image

from dpl import config as run
from dpl.commands import dry_run
from dpl.fem import read_mesh
from dpl.fem.linear import BACKENDS
from dpl.fem.mesh import group_names

ROOT = Path(__file__).parents[2]
DOCS, CONF, RESULTS = ROOT / "docs", ROOT / "conf", ROOT / "benchmarks" / "results"
MAKE = DOCS / "make"
WRITTEN = [*sorted(DOCS.glob("*.md")), *sorted(ROOT.glob("*.md"))]
BLOCK = re.compile(r"^```(python|yaml)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.M | re.S)


@pytest.fixture
def make(monkeypatch):
    """Imports a module of docs/make."""
    monkeypatch.syspath_prepend(str(MAKE))
    return importlib.import_module


@pytest.fixture
def blocks(tmp_path, monkeypatch):
    """Writes the files that a page's blocks name, and may run its other blocks of Python."""

    def blocks(page, *, run=True, **names):
        found = BLOCK.findall((DOCS / page).read_text(encoding="utf-8"))
        for _, name, text in found:
            if name:
                path = tmp_path / name
                path.parent.mkdir(parents=True, exist_ok=True)
                with path.open("a") as file:
                    file.write(text)
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(str(tmp_path))
        for kind, name, text in found:
            if run and kind == "python" and not name:
                exec(compile(text, page, "exec"), names)
        return names

    yield blocks
    sys.modules.pop("my_parts", None)
    BACKENDS.pop("dense", None)  # which my_parts.py adds


def test_every_option_is_listed_with_the_objects_that_it_names(make):
    text = make("options").page()
    for path in sorted(CONF.glob("*/*.yaml")):
        section = text.split(f"{{ #{path.parent.name}-{path.stem} }}")[1].split("\n### ")[0]
        listed = path.read_text(encoding="utf-8")
        assert listed.rstrip() in section, path
        for target in re.findall(r"_target_: (dpl\.[\w.]+)", listed):
            assert f"`{target}`" in section.split("```\n")[-1], (path, target)
    section = text.split("{ #scene }")[1].split("\n## ")[0]
    assert (CONF / "scene.yaml").read_text(encoding="utf-8").rstrip() in section


def test_every_command_of_the_package_is_listed_with_all_its_keys(make):
    text = make("options").page()
    commands = list(make("options").commands())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {f"dpl-{name}" for name, *_ in commands} == set(project["scripts"])
    for name, _, config in commands:
        section = text.split(f"{{ #command-{name} }}")[1].split("\n## ")[0]
        assert config.read_text(encoding="utf-8").rstrip() in section, name


def test_every_public_name_is_listed_and_documented_once(make):
    modules = make("modules")
    pages = dict(modules.pages())
    listed = [
        name for text in pages.values() for name in re.findall(r"^\| \[`(.*?)`\]", text, re.M)
    ]
    assert sorted(listed) == sorted(modules.documented().values())
    for path in (ROOT / "dpl").rglob("__init__.py"):
        package = importlib.import_module(".".join(path.parent.relative_to(ROOT).parts))
        for name in getattr(package, "__all__", ()):
            if name != "__version__":
                assert modules.anchor(f"{package.__name__}.{name}") in listed
    every = [name for text in pages.values() for name in re.findall(r"^::: (\S+)", text, re.M)]
    assert sorted(every) == sorted([*modules.exports(), *listed])


def test_the_reference_begins_with_the_names_of_the_package(make):
    modules = make("modules")
    depths = [folder.count(".") for folder in modules.exports()]
    assert next(iter(modules.exports())) == "dpl"
    assert depths == sorted(depths)
    for name in modules.exports()["dpl"]:
        assert modules.anchor(f"dpl.{name}") == f"dpl.{name}"


@pytest.mark.parametrize(
    ("name", "anchor"),
    [
        ("dpl.fem.Newton", "dpl.fem.Newton"),
        ("dpl.fem.Problem.residual", "dpl.fem.Problem.residual"),
        ("dpl.fem.solvers.newton.Newton", "dpl.fem.Newton"),
        ("dpl.training.Surrogate", "dpl.Surrogate"),
        ("dpl.fem.mesh", "dpl.fem.mesh"),
        ("dpl.fem.solvers.newton", None),
        ("dpl.no_such_name", None),
    ],
)
def test_a_name_is_linked_to_where_it_is_documented(make, name, anchor):
    assert make("modules").anchor(name) == anchor


def test_every_result_is_listed_with_the_command_that_makes_it():
    """In CONTRIBUTING.md, where patterns as `beam_*` stand for several files."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").split("\n## Measurements\n")[1]
    rows = re.findall(r"^\| `(\w+)`(?: .*?)?\|(.*)\|$", text, re.M)
    own = {path.stem for path in (ROOT / "benchmarks/conf").glob("*.yaml")}
    assert {name for name, _ in rows} == own
    patterns = [found for _, row in rows for found in re.findall(r"`([\w*]+)`", row)]
    for path in RESULTS.iterdir():
        assert any(fnmatch(path.stem, pattern) for pattern in patterns), path.name


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: path.name)
def test_every_row_of_a_table_has_as_many_cells_as_its_header(path):
    blocks = re.sub(r"^```.*?^```$", "", path.read_text(encoding="utf-8"), flags=re.M | re.S)
    blocks = re.sub(r"<!--.*?-->", "", blocks, flags=re.S)
    for table in re.findall(r"(?:^\|.*\n?)+", blocks, re.M):
        lines = table.splitlines()
        assert len(lines) > 1, lines
        assert re.fullmatch(r"\|( *:?-+:? *\|)+", lines[1]), lines[1]
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines}) == 1, lines[0]


TABLE = """<!-- results: csv=beam_svk; loads=in range
| e_mean | e_max, SNR_min |
-
method=paper
-->

| | a | b | c |
|---|---|---|---|
| one | | 2 | 3 |
| two | | | 4 |
"""


def test_the_stored_tables_are_those_of_the_results(make):
    """`make tables` writes them."""
    tables = make("tables")
    assert len(tables.pages()) > 5
    for path in tables.pages():
        text = path.read_text(encoding="utf-8")
        assert len(tables.BLOCK.findall(text)) == text.count("<!-- results"), path
        assert tables.updated(text) == text, path


def test_a_table_has_the_numbers_that_its_comment_names(make):
    tables = make("tables")
    rows = {row["method"]: row for row in tables.read("beam_svk") if row["loads"] == "in range"}
    names = ("e_mean", "e_max", "SNR_min")
    mean, largest, snr = (tables.shown(rows["paper"][name], name) for name in names)
    row = f"| two | {mean} | {largest}, {snr} | 4 |"
    assert tables.updated(TABLE) == TABLE.replace("| two | | | 4 |", row)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("csv=beam_svk; loads=in range", "csv=beam_svk; loads=small", "0 rows match"),
        ("method=paper", "count=100", "1[0-9] rows match"),
        ("-\n", "", "1 rows for a table of 2"),
        ("| two | | | 4 |", "| two | | 4 |", "table of 4 columns has the row"),
    ],
)
def test_a_table_that_differs_from_its_comment_is_refused(make, old, new, message):
    with pytest.raises(LookupError, match=message):
        make("tables").updated(TABLE.replace(old, new, 1))


@pytest.mark.parametrize(
    "text", ["0.0001934", "8e-06", "12345.6", "576000000", "0.73", "nan", "inf"]
)
def test_a_number_that_is_shown_is_the_one_in_the_file_to_two_digits(make, text):
    shown = make("tables").shown(text)
    assert float(shown.replace(",", "")) == pytest.approx(float(text), rel=0.05, nan_ok=True)


def test_formulas_become_mathml_with_their_number(make):
    html = r'<div class="arithmatex">\[ \frac{\lVert a \rVert}{\ln b} &lt; 1 \tag{7} \]</div>'
    drawn = make("formulas").mathml(html)
    assert "<mfrac>" in drawn
    assert drawn.count('<mo stretchy="false" lspace="0" rspace="0">&#x02016;</mo>') == 2
    assert '<mo lspace="0.17em" rspace="0.17em">ln</mo>' in drawn
    assert "&lt;" in drawn or "&#x0003C;" in drawn
    assert '<span class="tag">(7)</span></div>' in drawn
    assert "tag{" not in drawn


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: path.name)
def test_links_and_images_lead_to_files_that_are_there(make, path):
    for target in make("links").targets(path.read_text(encoding="utf-8")):
        if not target:
            continue
        place = (path.parent / target).resolve()
        generated = path.parent == DOCS and generated_page(make, target)
        assert place.exists() or generated, target


def generated_page(make, target):
    """Whether a link in docs/ leads to a page that the site makes."""
    paths = make("paths")
    return target in paths.GENERATED or target in paths.INCLUDED


def test_links_out_of_docs_lead_to_pages_of_the_site(make):
    rewritten = make("links").rewritten
    text = (
        "![a](../benchmarks/results/soak.png), [b](../DESIGN.md#rules), [c](options.md#x), "
        "[d](../LICENSE)"
    )
    assert rewritten(text, "docs/stress.md", "stress.md") == (
        "![a](results/soak.png), [b](design.md#rules), [c](options.md#x), d"
    )
    text = "[x](docs/data.md) and [y](https://a.b/c)\n```\n[z](docs/no.md)\n```"
    assert rewritten(text, "README.md", "readme.md") == (
        "[x](data.md) and [y](https://a.b/c)\n```\n[z](docs/no.md)\n```"
    )


def test_the_output_of_a_command_becomes_a_picture_that_names_no_host(make):
    text = "\x1b[31mred\x1b[0m and more\r\nsolving 1/2\rsolving 2/2\n" + 100 * "x" + "\n"
    drawn = make("terminal").svg(text, "make train")
    assert ">red<" in drawn
    assert "make&#160;train" in drawn or "make train" in drawn
    assert "solving&#160;2/2" in drawn
    assert "solving&#160;1/2" not in drawn
    assert f">{100 * 'x'}<" in drawn  # 100 columns, not divided
    assert not re.search(r"url\(.?https?:|href=.https?:|src=.https?:", drawn)


def test_a_notebook_is_stored_with_its_figures_and_shown_with_them(make, tmp_path, monkeypatch):
    executed, links = make("executed"), make("links")
    code = """import matplotlib.pyplot as plt, sys
print("\\x1b[31m40\\x1b[0m", 40 + 2)
print("said", file=sys.stderr)
plt.plot([1, 2])"""
    cells = [nbformat.v4.new_markdown_cell("# A trial"), nbformat.v4.new_code_cell(code)]
    metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    trial = tmp_path / "1_trial.ipynb"
    nbformat.write(nbformat.v4.new_notebook(cells=cells, metadata=metadata), trial)
    monkeypatch.setattr(executed, "NOTEBOOKS", tmp_path)
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    executed.execute(trial)
    notebook = nbformat.read(trial, as_version=4)
    nbformat.validate(notebook)
    text, figure = notebook.cells[1].outputs  # no stderr, no address of the last expression
    assert text.text == "40 42\n"
    assert list(figure.data) == ["image/png"]
    assert notebook.cells[1].execution_count is None
    assert notebook.metadata.code_sha256 == executed.code_digest(notebook)

    monkeypatch.setattr("nbclient.NotebookClient.execute", None)
    assert executed.title(executed.paths()[0]) == "A trial"
    (path, page), (name, content) = executed.pages()
    assert path == "notebooks/1_trial.md"
    assert "40 42" in page
    shown = links.rewritten(page, "notebooks/1_trial.ipynb", path)
    assert f"({name.removeprefix('notebooks/')})" in shown
    assert content.startswith(b"\x89PNG")


def test_the_pictures_of_the_gallery_belong_to_their_code(make):
    """`make pictures` makes them."""
    gallery = make("gallery")
    entries = gallery.entries()
    text = gallery.PAGE.read_text(encoding="utf-8")
    assert len(entries) == text.count("\n### ") >= 12
    assert {entry.path for entry in entries} == set(gallery.FOLDER.glob("*.webp"))
    for entry in entries:
        assert gallery.stored_digest(entry) == entry.digest, entry.name
        lines = [line for line in entry.code.splitlines() if line.strip()]
        assert len(lines) <= 15, entry.name
        assert f"### {entry.title}\n" in text
        assert entry.name == re.sub(r"\W+", "-", entry.title.lower())  # the anchor of its title
        assert f"(#{entry.name})" in gallery.shown(text)
    assert sum(entry.path.stat().st_size for entry in entries) < 1e6


@pytest.mark.parametrize(
    "names",
    [["a-bent-beam", "a-membrane-in-plane-strain"], pytest.param(None, marks=pytest.mark.slow)],
    ids=["two", "all"],
)
def test_the_code_of_the_gallery_draws_its_pictures(make, names, tmp_path, monkeypatch):
    if names is None:
        pytest.importorskip("pyvista")
        pytest.importorskip("gmsh")
    gallery = make("gallery")
    (tmp_path / "cad").symlink_to(gallery.DOCS / "cad")
    monkeypatch.chdir(tmp_path)
    with matplotlib.rc_context():
        for entry, figure in gallery.figures(names):
            with Image.open(io.BytesIO(gallery.picture(figure, entry.digest))) as image:
                assert image.width > 400, entry.name
                assert image.getexif()[gallery.DIGEST] == entry.digest


def test_the_examples_of_the_page_on_extensions_work(blocks, monkeypatch):
    made = blocks("extend.md")
    assert made["answers"].converged.all()
    assert made["pulled"].converged.all()
    assert made["load"].force.shape == (1, *made["small_body"].shape)
    monkeypatch.setattr(sys, "path", [str(Path.cwd()), *sys.path])
    GlobalHydra.instance().clear()
    own = f"hydra.searchpath=[file://{Path.cwd() / 'my_conf'}]"
    chosen = ["material=gent", "mesh=tube", "loads=bimodal", "model=modal", "loss=tip", "folder=."]
    try:
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            cfg = hydra.compose("train", overrides=[own, *chosen])
            run.check(cfg)
            scene = run.build_scene(cfg)
            surrogate = run.build_surrogate(cfg, scene)
            ends = hydra.compose("train", overrides=[own, "loads=end", "folder=."])
            run.check(ends)
            assert run.build_scene(ends).loads.largest == 9.0
    finally:
        GlobalHydra.instance().clear()
    assert scene.loads.distribution.keywords == {"gap": 0.3}
    assert (surrogate.net.inner[0].out_features, type(surrogate.loss).__name__) == (64, "TipError")
    search = yaml.safe_load((Path.cwd() / "my_conf/hparams_search/modal.yaml").read_text())
    assert set(search["hydra"]["sweeper"]["params"]) == {"model.width", "optimizer.lr"}
    assert search["defaults"][0] == {"override /model": "modal"}


@pytest.fixture
def own_conf(blocks):
    """Writes the files of a page and composes a training with them."""

    def compose(page, *overrides):
        if not Path("my_conf").is_dir():
            blocks(page, run=False)
        GlobalHydra.instance().clear()
        own = f"hydra.searchpath=[file://{Path.cwd() / 'my_conf'}]"
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            cfg = hydra.compose("train", overrides=[own, "folder=.", *overrides])
        run.check(cfg)
        return run.build_scene(cfg)

    yield compose
    GlobalHydra.instance().clear()


def test_the_load_family_of_the_page_on_extensions_is_in_pascals(own_conf):
    """Samples and fingerprint depend on the traction over E alone."""
    own = ["loads=end", "mesh.nodes=[5,3,3]"]
    soft = own_conf("extend.md", *own)
    stiff = own_conf("extend.md", *own, "loads.largest=18", "young=9e3")
    assert stiff.fingerprint == soft.fingerprint
    assert own_conf("extend.md", *own, "young=9e3").fingerprint != soft.fingerprint
    total = (stiff.loads.axes * 9e3 * stiff.force_unit).sum(dim=1)  # [N], on 25 m x 25 m
    assert total.diagonal().tolist() == pytest.approx([18 * 625.0] * 3)
    for override, message in (
        ("young=[1e3,2e3]", r"value = \[9\.0, 0\.0, 0\.0\] must be divided"),
        ("loads.largest=-1", r"largest = -1 must be a number above 0 \[Pa\]"),
    ):
        with pytest.raises(run.ConfigError, match=f"loads: {message}"):
            own_conf("extend.md", *own, override)


def test_the_boundary_values_of_the_page_on_usage_are_in_si_units(own_conf, tmp_path, monkeypatch):
    """Its Python needs a mesh file; the experiment is a body of 1,100 kg/m^3 on soil."""
    monkeypatch.chdir(tmp_path)
    Path("my_conf/experiment").mkdir(parents=True)
    found = BLOCK.findall((DOCS / "usage.md").read_text(encoding="utf-8"))
    (text,) = [text for _, name, text in found if name == "my_conf/experiment/soil.yaml"]
    Path("my_conf/experiment/soil.yaml").write_text(text)
    scene = own_conf("usage.md", "experiment=soil", "mesh.nodes=[5,3,3]")
    weight = scene.loads.constant_force.sum(dim=0) * 2e6 * scene.force_unit  # [N]
    assert weight.tolist() == pytest.approx([0, 0, -1100 * 9.81 / 16], abs=1e-9)
    pull = scene.problem.springs.force(torch.ones(1, *scene.problem.shape, dtype=torch.float64))
    assert float(pull[0, :, 2].sum()) * 2e6 == pytest.approx(1e7 / 4)  # 1 m x 0.25 m [N/m]


def command_lines(page):
    """Return names and arguments of the commands that a page shows, as a shell splits them."""
    text = (DOCS / page).read_text(encoding="utf-8").replace("\\\n", " ")
    lines = re.findall(r"^python scripts/(\w+)\.py *(.*)$", text, re.M)
    return [(name, shlex.split(rest, comments=True)) for name, rest in lines]


LAUNCHED = {"hydra/launcher=submitit_slurm", "hydra/launcher=submitit_local"}


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        line
        for page in ("index.md", "cad.md")
        for line in command_lines(page)
        if line[0] != "compare"  # has no configuration
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_the_commands_of_the_quick_start_are_valid(
    name, arguments, folder_of, tmp_path, monkeypatch
):
    """Every job of a command line is composed and checked, and none is started."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DPL_CONF", str(CONF))
    plain = [argument for argument in arguments if argument not in LAUNCHED]
    line = dry_run.arguments_of(plain, name, folder_of(name))
    with dry_run.initialized(line):
        single = dry_run.check(line)
    assert (single is None) == ("-m" in plain)  # the configuration of a single job


def test_the_script_of_the_page_on_cad_draws_a_quadratic_part_with_named_faces(
    tmp_path, monkeypatch
):
    script = (DOCS / "cad" / "mount.py").read_text()
    assert script in (DOCS / "cad.md").read_text()
    pytest.importorskip("gmsh")
    monkeypatch.chdir(tmp_path)
    exec(compile(script, "mount.py", "exec"), {})
    mesh = read_mesh("mount.msh", scale=1e-3)
    assert group_names(mesh) == ["foot", "rubber", "top"]
    assert mesh.p.shape[1] > 4 * mesh.nvertices
    assert np.ptp(mesh.p, axis=1) == pytest.approx([0.024, 0.024, 0.03], rel=1e-3)


@pytest.mark.slow  # trains eight runs
@pytest.mark.timeout(900)
def test_the_commands_of_the_quick_start_work_one_after_the_other(
    blocks, script, tmp_path, monkeypatch
):
    text = (DOCS / "index.md").read_text(encoding="utf-8")
    first = BLOCK.search(text)[3]
    monkeypatch.chdir(tmp_path)
    exec(compile(first, "index.md", "exec"), {})  # writes the mesh
    sizes = ["data.train=24", "data.val=4", "data.test=4", "data.workers=0"]
    sizes += ["loads.n_modes=3", "solver.linear=superlu"]
    for name, arguments in command_lines("index.md"):
        plain = [argument for argument in arguments if argument not in LAUNCHED]
        if name in ("train", "generate"):
            plain = [a for a in plain if not a.startswith("data.train")] + sizes
            plain += ["trainer.max_epochs=1"] * (name == "train")
            plain += ["mesh.nodes=[5,3,3]"] * ("mesh=file" not in plain)
        if name == "view" and not any("animation" in a for a in plain):
            continue  # serves the page until it is ended
        done = script(name, *plain, cwd=tmp_path)
        assert done.status in (0, None), (name, plain, done.err)
    assert (tmp_path / "runs/mine/export/model.onnx").is_file()
    assert (tmp_path / "mine.gif").is_file()
    names = blocks("index.md")
    assert names["exact"].residual < 1e-6
    assert names["bent"].converged


def test_python_and_yaml_that_are_shown_can_be_read():
    seen = set()
    for path in DOCS.glob("*.md"):
        for kind, _, text in BLOCK.findall(path.read_text(encoding="utf-8")):
            seen.add(kind)
            assert ast.parse(text).body if kind == "python" else yaml.safe_load(text), path
    assert seen == {"python", "yaml"}


@pytest.mark.slow  # reads the source of the package
def test_the_site_is_made_without_a_warning_and_asks_no_other_host_for_anything(tmp_path):
    site = tmp_path / "site"
    build = ["build", "--strict", "-f", MAKE / "mkdocs.yml", "-d", site]
    reported = subprocess.run(
        [sys.executable, "-m", "mkdocs", *build],
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert reported.returncode == 0, reported.stderr
    fetched = re.compile(
        r'<(?:script|img|link|iframe|source)[^>]*(?:src|href)="(?:https?:)?//[^"]+"'
    )
    for page in site.rglob("*.html"):
        text = re.sub(r'<link rel="canonical"[^>]*>', "", page.read_text(encoding="utf-8"))
        assert not fetched.search(text), page
    assert "<mfrac>" in (site / "concepts.html").read_text(encoding="utf-8")
    assert (site / "search/search_index.js").is_file()  # the search of pages from the disk
    assert '<script src="iframe-worker.js">' in (site / "index.html").read_text(encoding="utf-8")

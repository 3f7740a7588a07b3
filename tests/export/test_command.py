"""scripts/export.py: its files and its error messages."""

import json
import shutil

import meshio
import numpy as np
import pytest

from dpl.export import onnx_graph

MISSING = onnx_graph.missing_packages()


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Working directory of the commands."""
    return tmp_path_factory.mktemp("home")


@pytest.fixture
def trained(trained_run, home):
    """The working directory, with a copy of a short training run."""
    shutil.copytree(trained_run.parents[1], home, dirs_exist_ok=True)
    return home


@pytest.mark.skipif(bool(MISSING), reason=f"{', '.join(MISSING)} not installed (extra onnx)")
def test_export_writes_the_documented_folder(script, trained):
    ended = script("export", "run=runs/first", "samples=4", "count=2", cwd=trained)
    assert ended.status == 0, ended.err[-2000:]
    folder = trained / "runs/first/export"
    names = {path.name for path in folder.iterdir()}
    assert names == {
        *("model.onnx", "weights.safetensors", "meta.json", "modes.f64", "report.json"),
        *("reference", "results"),
    }
    report = json.loads((folder / "report.json").read_text(), parse_constant=pytest.fail)
    assert report["passed"]
    assert report["largest_error"] <= report["tolerance"] == 1e-4
    meta = json.loads((folder / "meta.json").read_text(), parse_constant=pytest.fail)
    judged = json.loads((trained / "runs/first/evaluation.json").read_text())
    assert meta["errors"] == judged[1]["errors"]
    assert "largest difference" in ended.out
    assert "results.pvd" in ended.out
    assert "[HYDRA]" not in ended.out + ended.err
    assert (folder / "results" / "results_001.vtu").is_file()
    ended = script("export", "run=runs/first", "outputs=[results]", "count=1", cwd=trained)
    assert ended.status == 0
    assert not (folder / "results" / "results_001.vtu").exists(), (
        "files of the earlier series are removed"
    )
    found = meshio.read(folder / "results" / "results_000.vtu").point_data
    assert np.isfinite(found["error [m]"]).all()


@pytest.mark.skipif(bool(MISSING), reason=f"{', '.join(MISSING)} not installed (extra onnx)")
def test_a_graph_with_too_large_a_difference_is_removed(script, trained):
    requested = ["run=runs/first", "folder=off", "outputs=[model]", "samples=4"]
    ended = script("export", *requested, "tol=1e-12", cwd=trained)
    assert ended.status == 1
    (line,) = ended.err.strip().splitlines()
    assert line.startswith("error: ONNX and torch differ by ")
    assert "tol = 1e-12" in line
    assert not (trained / "off" / "model.onnx").exists()
    assert not json.loads((trained / "off" / "report.json").read_text())["passed"]


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (
            ["run=runs/none", "outputs=[results]"],
            "run = runs/none has no config.yaml; train it first",
        ),
        (
            ["run=runs/first", "outputs=[modal]"],
            "outputs = ['modal'] must be a list, each one of model, results, runtime, dataset",
        ),
        (
            ["run=runs/first", "outputs=[]"],
            "outputs = [] must name one value or more: a list, each one of model, results, runtime",
        ),
        (["run=runs/first", "outputs=[runtime]"], "outputs: runtime: the run must be fitted with"),
        (["run=runs/first", "outputs=[results]", "count=0"], "count = 0 must be 1 or more"),
        (["run=runs/first", "tol=0"], "tol = 0 must lie between"),
        (["run=runs/first", "solve_reference=2"], "solve_reference = 2 must be true or false"),
    ],
)
def test_invalid_input_prints_one_line(script, trained, arguments, reported):
    ended = script("export", *arguments, cwd=trained)
    assert ended.status == 2
    assert f"error: {reported}" in ended.err
    assert len(ended.err.strip().splitlines()) == 1


def test_without_onnx_the_message_names_the_extra(script, trained, monkeypatch):
    monkeypatch.setattr(onnx_graph, "missing_packages", lambda: ["onnx"])
    ended = script("export", "run=runs/first", cwd=trained)
    assert ended.status == 2
    assert "error: outputs: model needs onnx: pip install" in ended.err
    assert "outputs=[results]" in ended.err


@pytest.mark.skipif(bool(MISSING), reason=f"{', '.join(MISSING)} not installed (extra onnx)")
def test_an_invalid_evaluation_file_is_reported(script, trained):
    shutil.copytree(trained / "runs/first", trained / "runs/broken")
    (trained / "runs/broken/evaluation.json").write_text("[{}]")
    ended = script("export", "run=runs/broken", "samples=1", cwd=trained)
    assert ended.status == 2
    assert "is not an evaluation" in ended.err

"""Laws of `--help` and `--cfg job`: they explain every key and import no torch."""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(path.stem for path in (ROOT / "scripts").glob("*.py"))
INSTALLED = [name for name in SCRIPTS if (ROOT / f"dpl/commands/{name}.py").is_file()]

PROGRAM = textwrap.dedent(
    """
    import contextlib, io, runpy, sys
    from hydra.core.global_hydra import GlobalHydra

    folder, commands, tiny = (word.split() for word in sys.argv[1:])

    def call(name, *arguments):
        sys.argv = [name, *arguments]
        GlobalHydra.instance().clear()
        try:
            runpy.run_path(f"{folder[0]}/{name}.py", run_name="__main__")
        except SystemExit as end:
            return end.code
        return 0

    for name in commands:
        for flags in (["--help"], ["--cfg", "job"]):
            reported = io.StringIO()
            with contextlib.redirect_stdout(reported):
                assert not call(name, *flags)
            assert reported.getvalue().strip(), (name, flags)
    for line in ("evaluate run=no", "view run=no", "export run=no", "compare run=no",
                 "train model=fcnn model.widht=3"):
        assert call(*line.split()) == 2, line
    heavy = {"torch", "lightning", "numba", "skfem", "scipy"} & set(sys.modules)
    assert not heavy, heavy
    call("generate", "data.train=3", "data.val=1", "data.test=1", "data.workers=0", *tiny)
    heavy = {"lightning", "torchmetrics", "matplotlib", "tensorboard", "pytorch_lightning"}
    assert "torch" in sys.modules
    assert not heavy & set(sys.modules), heavy & set(sys.modules)
    from dpl.config import load_run
    from dpl.inference import Simulator
    assert "lightning" not in sys.modules
    """
)


def test_help_and_errors_need_no_torch_and_generated_loads_and_loaded_runs_no_lightning(
    environment, tmp_path, tiny
):
    words = str(ROOT / "scripts"), " ".join(INSTALLED), " ".join(tiny)
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, *words],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert "train: 3 of 3 loads accepted" in ended.stdout
    assert [line.partition(":")[0] for line in ended.stderr.splitlines()] == ["error"] * 5
    assert [path.name for path in tmp_path.iterdir()] == ["datasets"]


def test_help_ends_quietly_where_the_reader_of_its_output_has_ended(environment, tmp_path):
    """As `--help | head` does; with the status of a process that SIGPIPE ends."""
    line = f"{sys.executable} {ROOT / 'scripts/view.py'} --help | true; echo ${{PIPESTATUS[0]}}"
    command = ["bash", "-c", line]
    ended = subprocess.run(
        command, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False
    )
    assert (ended.stdout, ended.stderr) == ("141\n", "")


@pytest.mark.parametrize("name", SCRIPTS)
def test_help_names_every_key(script, compose, name, tmp_path):
    ended = script(name, "--help", cwd=tmp_path)
    assert ended.status in (0, None)
    lines = "\n".join(line.strip() for line in ended.out.splitlines())
    for key in compose(command="evaluate" if name == "compare" else name):
        assert any(f"\n{text}" in lines for text in (f"{key}:", f"keys of {key},")), key


def test_help_follows_the_options_of_the_command_line(script, tmp_path):
    ended = script("train", "--help", "mesh=propeller", "optimizer.lr=0.25", cwd=tmp_path)
    assert "  blades: 5" in ended.out
    assert "beam, file, finger, paper_beam, propeller*, rectangle" in " ".join(ended.out.split())
    assert "circle of the tips [m]" in ended.out, "the comment of a key"
    ended = script("train", "--help", "modle=3", cwd=tmp_path)
    assert ended.status == 2
    assert ended.err == "error: modle: there is no such key; did you mean model?\n"


def test_help_of_a_benchmark_lists_options_and_comments_of_the_package(script, tmp_path):
    reported = " ".join(script("soak", "--help", cwd=tmp_path).out.split())
    assert "model cnn, fcnn*, fcnn_paper, gnn, pod, unrolled" in reported
    assert "# learning rate [-]" in reported
    ended = script("soak", "model=fcm", cwd=tmp_path)
    assert "Could not find 'model/fcm'" in ended.err

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

    for script in sys.argv[1:]:
        for flags in (["--help"], ["--cfg", "job"]):
            sys.argv = [script, *flags]
            GlobalHydra.instance().clear()
            reported = io.StringIO()
            with contextlib.redirect_stdout(reported), contextlib.suppress(SystemExit):
                runpy.run_path(script, run_name="__main__")
            assert reported.getvalue().strip(), (script, flags)
            heavy = {"torch", "lightning", "numba", "skfem", "scipy"} & set(sys.modules)
            assert not heavy, (script, flags, heavy)
    """
)


def test_help_and_the_configuration_of_installed_commands_import_no_torch(environment, tmp_path):
    paths = [str(ROOT / "scripts" / f"{name}.py") for name in INSTALLED]
    command = [sys.executable, "-c", PROGRAM, *paths]
    ended = subprocess.run(
        command, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert not list(tmp_path.iterdir())


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
    assert "model cnn, fcnn, fcnn_paper, gnn, pod, unrolled*" in reported
    assert "# learning rate [-]" in reported
    ended = script("soak", "model=fcm", cwd=tmp_path)
    assert "Could not find 'model/fcm'" in ended.err

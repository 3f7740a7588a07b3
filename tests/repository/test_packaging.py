"""The wheel holds all that the commands need, and they run from it outside the checkout."""

import importlib
import inspect
import os
import pkgutil
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
METADATA = tomllib.loads((ROOT / "pyproject.toml").read_text())
INTERNAL = ("cli", "dry_run", "overrides")  # modules that commands share
COMMANDS = METADATA["project"]["scripts"]


@pytest.fixture(scope="session")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built from this checkout."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    build = ["pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(folder)]
    subprocess.run([sys.executable, "-m", *build, str(ROOT)], check=True, capture_output=True)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="session")
def installed(wheel, tmp_path_factory) -> Path:
    """A folder that the wheel is unpacked into, as an installation does."""
    folder = tmp_path_factory.mktemp("site")
    zipfile.ZipFile(wheel).extractall(folder)
    return folder


def run_from(
    installed: Path, name: str, *arguments: str, cwd: Path, compiles: bool = False
) -> subprocess.CompletedProcess:
    """Run a console script as pip writes it, with nothing of the checkout on the path.

    What solves nothing need not compile loops where the wheel lies, which takes 10 s.
    """
    module, function = COMMANDS[f"dpl-{name}"].split(":")
    code = f"import sys; from {module} import {function}; sys.exit({function}())"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=cwd,
        env={
            **os.environ,
            "PYTHONPATH": str(installed),
            "OMP_NUM_THREADS": "1",
            "NUMBA_DISABLE_JIT": str(int(not compiles)),
        },
        capture_output=True,
        text=True,
    )


def test_every_script_calls_a_command_that_has_a_console_script():
    scripts = {path.stem for path in (ROOT / "scripts").glob("*.py")}
    installed = {path.stem for path in (ROOT / "dpl/commands").glob("*.py")}
    installed -= {"__init__", *INTERNAL}
    local = {path.stem for path in (ROOT / "benchmarks/conf").glob("*.yaml")}
    assert scripts == installed | local
    assert {f"dpl-{name}": f"dpl.commands.{name}:main" for name in installed} == COMMANDS


def test_the_wheel_holds_all_configurations_and_says_that_it_is_typed(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    conf = {f"dpl/{path.relative_to(ROOT)}" for path in (ROOT / "conf").rglob("*.yaml")}
    assert conf <= names
    assert {"dpl/py.typed", "dpl/consumers/dpl_runtime.hpp"} <= names
    assert {name.split("/")[0] for name in names} <= {
        "dpl",
        wheel.name.split("-py3")[0] + ".dist-info",
    }


@pytest.mark.slow  # compiles all loops
def test_a_command_of_the_wheel_runs_in_an_empty_folder(installed, tmp_path, tiny):
    sizes = ["data.train=4", "data.val=2", "data.test=2", "data.workers=0"]
    done = run_from(installed, "generate", *tiny, *sizes, cwd=tmp_path, compiles=True)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["datasets"]


def test_a_configuration_of_ones_own_stands_beside_those_of_the_wheel(installed, tmp_path):
    own = tmp_path / "mine/material"
    own.mkdir(parents=True)
    (own / "soft.yaml").write_text("_target_: dpl.fem.NeoHookeanLn\npoisson: 0.7\n")
    requested = ["--config-dir", "mine", "material=soft"]
    refused = run_from(installed, "generate", *requested, cwd=tmp_path)
    assert refused.returncode == 2
    assert refused.stderr.startswith("error: material: poisson = 0.7 must")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_the_version_is_said_once_more_where_tools_look_for_it():
    version = METADATA["project"]["version"]
    code = (ROOT / "dpl/version.py").read_text()
    assert f'__version__ = "{version}"' in code
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert re.search(rf"^## {re.escape(version)} - ", (ROOT / "CHANGELOG.md").read_text(), re.M)


PACKAGES = [
    ".".join(path.parent.relative_to(ROOT).parts)
    for path in sorted(ROOT.glob("dpl/**/__init__.py"))
]


@pytest.mark.parametrize("name", PACKAGES)
def test_every_public_name_is_there_and_is_not_the_name_of_a_module(name):
    package = importlib.import_module(name)
    modules = {module.name for module in pkgutil.iter_modules(package.__path__)}
    assert modules.isdisjoint(getattr(package, "__all__", ()))
    for public in getattr(package, "__all__", ()):
        assert not inspect.ismodule(getattr(package, public))
    assert set(dir(package)) >= set(getattr(package, "__all__", ()))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        package.nothing  # noqa: B018


def test_to_import_the_package_imports_neither_torch_nor_scipy():
    code = "import dpl, sys; print({'torch', 'scipy', 'numpy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"

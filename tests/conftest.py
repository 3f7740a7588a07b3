"""A tiny scene with its data, and ways to run the scripts, that the tests share."""

import io
import json
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import hydra
import matplotlib
import numpy as np
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hypothesis import HealthCheck, settings
from omegaconf import DictConfig
from threadpoolctl import threadpool_limits

from dpl import Sample, Scene
from dpl.config import build, plain
from dpl.data import DataModule
from dpl.fem import ModalLoads, NeoHookeanLn, Newton, Plane, Problem, box
from dpl.fem.mesh import sandbox, sandbox_worker

THREADS = int(os.environ.get("DPL_TEST_THREADS", "1"))  # see tests/matrix.py
torch.set_num_threads(THREADS)
threadpool_limits(THREADS)
matplotlib.use("Agg")
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell starts what it puts behind &
    signal.signal(signal.SIGINT, signal.default_int_handler)  # else processes of tests ignore it

# pytest --hypothesis-profile=many tests/properties: anew each time, and a hundred times as long
_fixtures = {
    "deadline": None,
    "suppress_health_check": [HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
}
settings.register_profile("few", max_examples=10, derandomize=True, database=None, **_fixtures)
settings.register_profile("many", max_examples=1000, print_blob=True, **_fixtures)
settings.load_profile("few")

ROOT = Path(__file__).parents[1]
LONG = "tests/repository/test_notebooks.py"  # few tests that take minutes
CONF = ROOT / "conf"
os.environ["DPL_CONF"] = str(CONF)  # as each command does


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest tests first, so that processes that share the tests end together."""
    items.sort(key=lambda item: not item.nodeid.startswith(LONG))


@pytest.fixture(scope="session")
def tiny() -> list[str]:
    """Overrides that make the tiny scene of any command."""
    return ["mesh.nodes=[5,3,3]", "loads.n_modes=3", "solver.linear=superlu"]


@pytest.fixture(scope="session")
def tiny_training(tiny) -> list[str]:
    """Overrides that make a short training run, without worker processes."""
    data = ["data.train=16", "data.val=4", "data.test=4", "data.batch_size=8", "data.workers=0"]
    return [*tiny, *data, "trainer.check_val_every_n_epoch=1", "experiment=paper", "model.width=16"]


def _tiny(
    *,
    size=(100.0, 25.0, 25.0),
    nodes=(5, 3, 3),
    cell="hexahedron",
    law=NeoHookeanLn,
    poisson=0.3,
    mesh=None,
    fixed=None,
    degree=1,
    tol=1e-8,
    linear="superlu",
    newton=Newton,
    young=4500.0,
    n_modes=3,
    **loads,
) -> Scene:
    mesh = box(size, nodes, cell) if mesh is None else mesh
    held = Plane(0, "min") if fixed is None else fixed
    problem = Problem.build(mesh, law(poisson), fixed=held, degree=degree)
    solver = newton(problem, tol=tol, linear=linear)
    loads = ModalLoads(solver.linear_solver, n_modes=n_modes, young=young, **loads)
    return Scene(problem, loads, solver)


@pytest.fixture(scope="session")
def make_scene() -> Callable[..., Scene]:
    """Builds variants of the tiny scene."""
    return _tiny


@pytest.fixture(scope="session")
def scene() -> Scene:
    """A beam 100 x 25 x 25 m of 16 hexahedra, E = 4500 Pa, held at x = 0, three modes."""
    return _tiny()


@pytest.fixture(scope="session")
def folder(tmp_path_factory) -> Path:
    """The folder of the tiny data set; read it, do not write there."""
    return tmp_path_factory.mktemp("data") / "tiny"


@pytest.fixture(scope="session")
def _solved(scene, folder) -> Path:
    DataModule(scene, folder=str(folder), train=12, val=4, test=4, workers=0).prepare_data()
    return folder


@pytest.fixture
def data(scene, _solved) -> DataModule:
    """The tiny data set: 12, 4 and 4 loads, all solved."""
    return DataModule(scene, folder=str(_solved), train=12, val=4, test=4, batch_size=4, workers=0)


@pytest.fixture(scope="session")
def batch(scene, _solved) -> Sample:
    """Twelve solved loads."""
    return DataModule(scene, folder=str(_solved), train=12, val=4, test=4, workers=0).samples(
        "train"
    )


def _folder_of(command: str) -> Path:
    """Return the folder of a command's configuration."""
    folders = CONF, ROOT / "benchmarks" / "conf"
    return next(folder for folder in folders if (folder / f"{command}.yaml").is_file())


@pytest.fixture(scope="session")
def folder_of() -> Callable[[str], Path]:
    """Finds the folder of a command's configuration."""
    return _folder_of


@pytest.fixture
def compose(monkeypatch, tmp_path) -> Iterator[Callable[..., DictConfig]]:
    """Composes a command's configuration as its script does, in a folder of its own."""
    monkeypatch.chdir(tmp_path)

    def compose(*overrides: str, command: str = "generate") -> DictConfig:
        GlobalHydra.instance().clear()
        with hydra.initialize_config_dir(str(_folder_of(command)), version_base="1.3"):
            return hydra.compose(command, overrides=list(overrides))

    yield compose
    GlobalHydra.instance().clear()


@pytest.fixture
def scene_of(compose) -> Callable[..., Scene]:
    """Checks and builds the scene of overrides of `conf/generate.yaml`."""

    def scene_of(*overrides: str) -> Scene:
        cfg = compose(*overrides)
        plain.check(cfg)
        return build.build_scene(cfg)

    return scene_of


@pytest.fixture(scope="session")
def environment() -> Callable[..., dict[str, str]]:
    """Environments of processes that can import `dpl` and use so many threads."""
    return _environment


def _environment(threads: int = THREADS) -> dict[str, str]:
    one = dict.fromkeys(
        ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads)
    )
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    return {**os.environ, **one, "PYTHONPATH": path, "MPLBACKEND": "Agg", "COLUMNS": "200"}


@pytest.fixture(scope="session")
def members() -> Callable[[int], list[int]]:
    """Lists the living processes of a process group."""
    return _members


@pytest.fixture(scope="session")
def workers_of() -> Callable[[int], list[int]]:
    """Lists the living worker processes of a process group: children of their server."""

    def workers(group: int) -> list[int]:
        parents = {}
        for pid in _members(group):
            with suppress(OSError):  # it has just ended
                if "forkserver" in Path(f"/proc/{pid}/cmdline").read_text():
                    stat = Path(f"/proc/{pid}/stat").read_text()
                    parents[pid] = int(stat.rpartition(")")[2].split()[1])
        return [pid for pid, parent in parents.items() if parent in parents]

    return workers


def _members(group: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(fields[2]) == group and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


@pytest.fixture(scope="session")
def start() -> Iterator[Callable[..., subprocess.Popen]]:
    """Starts a script in a process group of its own; what is left of it is killed in the end."""
    started: list[subprocess.Popen] = []

    def start(script: str, *arguments: str, cwd: Path) -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "scripts" / f"{script}.py"), *arguments],
            cwd=cwd,
            env=_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        for pid in _members(process.pid):
            os.kill(pid, signal.SIGKILL)
        process.communicate()


@pytest.fixture
def script(monkeypatch, capfd) -> Callable[..., SimpleNamespace]:
    """Runs a script in this process, which saves its imports; returns status, out and err."""

    def script(name: str, *arguments: str, cwd: Path) -> SimpleNamespace:
        monkeypatch.chdir(cwd)
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
        GlobalHydra.instance().clear()
        capfd.readouterr()
        status = 0
        try:
            runpy.run_path(str(ROOT / "scripts" / f"{name}.py"), run_name="__main__")
        except SystemExit as end:
            status = end.code
        finally:
            GlobalHydra.instance().clear()
        return SimpleNamespace(status=status, **capfd.readouterr()._asdict())

    return script


@pytest.fixture(scope="session")
def _home_of_run(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("trained")


@pytest.fixture
def trained_run(script, tiny_training, _home_of_run) -> Path:
    """The folder of a training run of one epoch, made once; read it, do not write there."""
    run = _home_of_run / "runs" / "first"
    if not run.exists():
        short = ["trainer.max_epochs=1", "run=runs/first"]
        ended = script("train", *tiny_training, *short, cwd=_home_of_run)
        assert ended.status == 0, ended.err[-2000:]
    return run


@pytest.fixture
def in_process(monkeypatch) -> None:
    """Read mesh files in this process, which is faster than the start of one for each."""

    def run(program: list[str], **_: object) -> subprocess.CompletedProcess:
        arrays: dict[str, np.ndarray] = {}
        answer, output = sandbox_worker.read(Path(program[4]), arrays), io.BytesIO()
        np.savez(output, answer=np.array(json.dumps(answer)), **arrays)
        return subprocess.CompletedProcess(program, 0, output.getvalue())

    names = {name: getattr(subprocess, name) for name in ("DEVNULL", "PIPE", "TimeoutExpired")}
    monkeypatch.setattr(sandbox, "subprocess", SimpleNamespace(run=run, **names))

"""A killed and resumed run equals an uninterrupted one bit for bit.

Processes are killed (SIGKILL) within a step or while writing a checkpoint. The temporary folder is
on another file system.
"""

import contextlib
import hashlib
import io
import os
import resource
import runpy
import shutil
import signal
import sys
import tempfile
import traceback
from functools import partial
from pathlib import Path

import pytest
import torch
from hydra.core.global_hydra import GlobalHydra

from dpl.training import Surrogate, checkpoints
from dpl.training.callbacks import checkpointing
from dpl.training.checkpoints import read

ROOT = Path(__file__).parents[2]
EPOCHS = 6  # of two steps each
ELSEWHERE = "/dev/shm"  # another file system: what is renamed from there to here is copied

NOISY = """
import random

import numpy as np
import torch
from torch import nn


class Noisy(nn.Module):
    '''A network whose training draws from every generator there is.'''

    def __init__(self, scene, *, layers=0, width=None, all_dofs=False):
        super().__init__()
        size = scene.problem.points.numel()
        self.dropout, self.linear = nn.Dropout(0.3), nn.Linear(size, size)
        random.seed(0)
        np.random.seed(0)

    def forward(self, force, scalars):
        x = self.dropout(force.flatten(1))
        if self.training:
            x = x * (1 + 0.1 * random.gauss(0, 1) + 0.1 * np.random.standard_normal())
        return self.linear(x).view_as(force)
"""


def killing(where, at):
    """Kill this process in the step `at`, or while it writes a checkpoint of the epoch `at`."""
    step, write, atomic_write = Surrogate.training_step, checkpoints.write, checkpoints.atomic_write
    epoch = None

    def die():
        os.kill(os.getpid(), signal.SIGKILL)

    def training_step(self, batch, batch_idx):
        loss = step(self, batch, batch_idx)
        if self.trainer.global_step == at:
            die()
        return loss

    def writing(checkpoint, path):
        nonlocal epoch
        epoch = checkpoint["epoch"]
        write(checkpoint, path)

    @contextlib.contextmanager
    def half_file(path):
        with atomic_write(path) as file:
            content = io.BytesIO()
            yield content
            if epoch == at and where == path.name:
                file.write(content.getvalue()[: len(content.getvalue()) // 2])
                file.flush()
                die()
            file.write(content.getvalue())

    if where == "step":
        Surrogate.training_step = training_step
    else:
        checkpointing.write, checkpoints.atomic_write = writing, half_file


def limiting(name, most):
    """Limit the size of files from the third epoch on, which simulates a full disk."""
    write = checkpoints.write

    def full(checkpoint, path):
        if path.name == name and checkpoint["epoch"] == 2:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))
        write(checkpoint, path)

    checkpointing.write = full


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with a user's network, and later a data set."""
    home = tmp_path_factory.mktemp("resume")
    (home / "noisy.py").write_text(NOISY)
    return home


@pytest.fixture
def elsewhere(monkeypatch, home):
    """The environment of all runs."""
    if not Path(ELSEWHERE).is_dir() or os.stat(ELSEWHERE).st_dev == os.stat(home).st_dev:
        pytest.skip("there is no second file system")
    monkeypatch.setenv("TMPDIR", ELSEWHERE)
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.syspath_prepend(str(home))
    assert tempfile.gettempdir() == ELSEWHERE


@pytest.fixture
def overrides(tiny_training, home):
    """Builds the command line of a run."""

    def overrides(name, net):
        networks = {"fcnn": ["model.width=8"], "noisy": ["model._target_=noisy.Noisy"]}
        kept = [o for o in tiny_training if "model." not in o]
        quiet = "callbacks.progress_bar._target_=lightning.pytorch.callbacks.TQDMProgressBar"
        sizes = [f"data.folder={home}/data", f"trainer.max_epochs={EPOCHS}", "data.workers=0"]
        return [*kept, *networks[net], *sizes, f"run={name}", quiet, "logger=none"]

    return overrides


@pytest.fixture(scope="module")
def ended():
    """The last checkpoints of uninterrupted runs, by network."""
    return {}


@pytest.fixture
def straight(elsewhere, script, overrides, home, ended):
    """Train without interruption; return the last checkpoint."""

    def straight(net):
        if net not in ended:
            run = script("train", *overrides(net, net), cwd=home)
            assert run.status == 0, run.err
            ended[net] = last(home / net)
        return ended[net]

    return straight


@pytest.fixture
def forked(elsewhere, overrides, home, monkeypatch):
    """Train in a copy of this process after a preparation; return its status and stderr."""
    monkeypatch.chdir(home)

    def forked(prepare, name, net="fcnn"):
        arguments, (read_end, write_end) = overrides(name, net), os.pipe()
        if (child := os.fork()) == 0:
            status = 1
            try:
                os.dup2(write_end, 2)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
                sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__
                sys.argv = ["train.py", *arguments]
                GlobalHydra.instance().clear()
                prepare()
                runpy.run_path(str(ROOT / "scripts/train.py"), run_name="__main__")
            except SystemExit as end:
                status = end.code or 0
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(status)
        os.close(write_end)
        with open(read_end) as pipe:
            err = pipe.read()
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), err

    return forked


@pytest.fixture
def killed(forked, home):
    """Start a run that kills itself, see `killing`; return its folder."""

    def killed(name, net, where, at):
        status, err = forked(partial(killing, where, at), name, net)
        assert status == -signal.SIGKILL, err[-2000:]
        return home / name

    return killed


def last(folder):
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)


def digest(value):
    """Return the SHA-256 of plain data with tensors."""
    found = hashlib.sha256()
    for path, leaf in torch.utils._pytree.tree_flatten_with_path(value)[0]:
        found.update(f"{path}{type(leaf)}".encode())
        found.update(leaf.numpy().tobytes() if torch.is_tensor(leaf) else repr(leaf).encode())
    return found.hexdigest()


def assert_same(one, other):
    """Assert that two checkpoints have equal weights, optimiser, schedule and random states."""
    assert (one["epoch"], one["global_step"]) == (EPOCHS - 1, 2 * EPOCHS)
    assert (other["epoch"], other["global_step"]) == (EPOCHS - 1, 2 * EPOCHS)
    for part in ("state_dict", "optimizer_states", "lr_schedulers"):
        assert digest(one[part]) == digest(other[part]), part


@pytest.mark.parametrize(
    ("name", "most"),
    [pytest.param("best.safetensors", 0, marks=pytest.mark.slow), ("last.ckpt", 50_000)],
)
def test_a_full_disk_ends_training_with_one_line_and_intact_files(forked, home, name, most):
    run = f"full-{name}-{most}"
    status, err = forked(partial(limiting, name, most), run)
    assert status == 2, err[-2000:]
    line = err.strip().splitlines()[-1]
    assert line.startswith("error: File too large"), line
    assert "Traceback" not in err
    assert last(home / run)["epoch"] == 1, "the checkpoint before is whole"
    assert read(home / run / "checkpoints/best.safetensors")["epoch"] <= 2
    left = {path.name for path in (home / run / "checkpoints").iterdir()}
    assert left == {"best.safetensors", "last.ckpt"}


@pytest.mark.parametrize("net", ["noisy", pytest.param("fcnn", marks=pytest.mark.slow)])
def test_a_run_killed_in_a_step_ends_bit_for_bit_like_an_uninterrupted_one(
    straight, killed, script, overrides, home, net
):
    """The run is resumed with its command line, and without it."""
    name, alone = f"step-{net}", f"alone-{net}"
    folder = killed(name, net, "step", 7)  # the second of epoch 3
    assert last(folder)["epoch"] == 2
    shutil.copytree(folder, home / alone)
    quiet = "callbacks.progress_bar._target_=lightning.pytorch.callbacks.TQDMProgressBar"
    own = ["trust=true"] if net == "noisy" else []  # a network of the user
    run = script("train", f"run={alone}", "ckpt_path=last", quiet, *own, cwd=home)
    assert run.status == 0, run.err
    assert_same(straight(net), last(home / alone))
    run = script("train", *overrides(name, net), "ckpt_path=last", cwd=home)
    assert run.status == 0, run.err
    assert "; 0 of them to be solved" in run.out
    assert_same(straight(net), last(folder))
    best = [read(home / name / "checkpoints/best.safetensors") for name in (net, name)]
    assert best[0]["epoch"] == best[1]["epoch"]
    assert digest(best[0]["state_dict"]) == digest(best[1]["state_dict"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("where", "at", "there"),
    [
        ("step", 2, 0),  # the first step of the second epoch
        ("step", 11, 4),  # the very last one
        ("last.ckpt", 3, 2),  # half of a checkpoint is written
        ("best.safetensors", 3, 2),
        ("last.ckpt", 5, 4),  # that of the last epoch
    ],
)
def test_wherever_a_run_is_killed_it_ends_bit_for_bit_the_same(
    straight, killed, script, overrides, home, where, at, there
):
    name = f"{where.partition('.')[0]}{at}"
    folder = killed(name, "fcnn", where, at)
    assert last(folder)["epoch"] == there, "the checkpoint before is whole"
    run = script("train", *overrides(name, "fcnn"), "ckpt_path=last", cwd=home)
    assert run.status == 0, run.err
    assert_same(straight("fcnn"), last(folder))
    left = sorted(path.name for path in (folder / "checkpoints").iterdir())
    assert left == ["best.safetensors", "last.ckpt"], "no partial files"

"""Training in several processes: equal weights, one evaluation, no sweeps."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from types import SimpleNamespace

import lightning as L
import pytest
from hydra.types import RunMode
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.environments import LightningEnvironment
from omegaconf import OmegaConf

from dpl.commands import cli
from dpl.config import ConfigError

ROOT = Path(__file__).parents[2]
SCHEDULED = OmegaConf.create(
    {"scheduler": {"_target_": "dpl.training.warmup_cosine"}, "folder": "."}
)
TWO = ["trainer.accelerator=cpu", "trainer.devices=2", "++trainer.strategy=ddp"]


SPY = textwrap.dedent(
    """
    import hashlib
    import os

    import lightning as L


    class Spy(L.Callback):
        '''Writes down what each process ends with, and which loads it has seen.'''

        def __init__(self):
            self.seen = []

        def on_train_batch_start(self, trainer, module, batch, batch_idx):
            self.seen += [hashlib.sha256(one.numpy().tobytes()).hexdigest() for one in batch.force]

        def on_fit_end(self, trainer, module):
            found = hashlib.sha256()
            for name, value in module.state_dict().items():
                found.update(name.encode() + value.contiguous().numpy().tobytes())
            with open(f"rank-{trainer.global_rank}", "w") as file:
                print(found.hexdigest(), *self.seen, file=file)
    """
)


@pytest.fixture
def trained(tiny_training, environment, members, tmp_path):
    """Train in two processes; return status, output, errors and the samples of each process."""

    def trained(*overrides):
        kept = [o for o in tiny_training if "data.train" not in o or "data=online" not in overrides]
        (tmp_path / "spy.py").write_text(SPY)
        env = environment()
        env["PYTHONPATH"] = os.pathsep.join([str(tmp_path), env["PYTHONPATH"]])
        spy = "callbacks.progress_bar._target_=spy.Spy"
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "scripts/train.py"), *kept, *TWO, spy, *overrides],
            cwd=tmp_path,
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        try:
            out, err = process.communicate(timeout=240)
            end = time.monotonic() + 60
            while members(process.pid) and time.monotonic() < end:
                time.sleep(0.1)
            assert not members(process.pid), "processes are left"
        finally:
            for pid in members(process.pid):
                os.kill(pid, signal.SIGKILL)
        ranks = [path.read_text().split() for path in sorted(tmp_path.glob("rank-*"))]
        return process.returncode, out, err, ranks

    return trained


@pytest.mark.slow
def test_two_processes_end_with_equal_weights_and_one_evaluation(trained, tmp_path):
    status, out, err, ranks = trained("trainer.max_epochs=3", "run=r")
    assert status == 0, err[-3000:]
    (weights, *seen), (others, *rest) = ranks
    assert weights == others
    assert len(seen) == len(rest) == 3 * 8, "of 16 loads, half to each"
    for k in range(3):
        one, other = set(seen[8 * k : 8 * k + 8]), set(rest[8 * k : 8 * k + 8])
        assert len(one | other) == 16
    assert out.count("test loads") == 1
    assert out.count("skipped   ") == 1
    rows = json.loads((tmp_path / "r/evaluation.json").read_text())
    assert next(row for row in rows if row["solver"].startswith("paper"))["converged"] == 4
    assert sorted(path.name for path in (tmp_path / "r/checkpoints").iterdir()) == [
        "best.safetensors",
        "last.ckpt",
    ]
    assert [path.name for path in tmp_path.glob("runs*")] == []
    (data,) = (tmp_path / "datasets").iterdir()
    assert len((data / "journal.jsonl").read_text().splitlines()) == 1, "one process has solved"
    assert len(list(data.glob("*-000000.safetensors"))) == 3
    assert OmegaConf.load(tmp_path / "r/config.yaml").trainer.devices == 2
    assert not list(tmp_path.rglob(".*.part"))


@pytest.mark.slow
def test_two_processes_of_an_unnamed_run_share_one_folder(trained, tmp_path):
    """The default name contains the time, and the second process starts seconds later."""
    status, _, err, ranks = trained("trainer.max_epochs=1")
    assert status == 0, err[-3000:]
    assert ranks[0][0] == ranks[1][0]
    assert len(list((tmp_path / "runs").iterdir())) == 1


@pytest.mark.slow
def test_two_processes_share_one_stream(trained):
    online = [
        "data=online",
        "data.workers=0",
        "data.train.batches=2",
        "data.train.new_per_round=8",
        "data.train.reuse=1",
    ]
    status, _, err, ranks = trained(*online, "trainer.max_epochs=2", "run=r")
    assert status == 0, err[-3000:]
    (weights, *seen), (others, *rest) = ranks
    assert weights == others
    assert len(set(seen)) == len(set(rest)) == 32, "two epochs of two batches of eight"
    assert not set(seen) & set(rest)


# ------------------------------------------------------------------ sweeps


def test_a_sweep_of_multi_process_runs_raises_an_error_with_the_remedy(script, tiny, tmp_path):
    sizes = ["data.workers=0", "data.train=4", "run=sweep"]
    ended = script(
        "train", "-m", "model=fcnn", "loss=mse,lr_star", *tiny, *sizes, *TWO, cwd=tmp_path
    )
    assert ended.status == 2
    *_, line = ended.err.strip().splitlines()
    assert line.startswith("error: trainer.strategy: with -m, ")
    assert "ddp_spawn" in line
    assert "Traceback" not in ended.err
    assert "plan:" not in ended.out
    assert "solving" not in ended.out
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["multirun.yaml"]


class Outside(LightningEnvironment):
    """A cluster or torchrun has started all processes."""

    creates_processes_externally = True


@pytest.mark.parametrize(
    ("mode", "options", "refused"),
    [
        (RunMode.MULTIRUN, {"devices": 2, "strategy": "ddp"}, True),
        (RunMode.MULTIRUN, {"devices": 2, "strategy": "ddp_find_unused_parameters_true"}, True),
        (RunMode.MULTIRUN, {"devices": 2, "strategy": "ddp_spawn"}, False),
        (RunMode.MULTIRUN, {"devices": 1}, False),
        (RunMode.MULTIRUN, {"devices": 1, "strategy": "ddp"}, False),
        (RunMode.MULTIRUN, {"devices": 2, "strategy": "ddp", "plugins": [Outside()]}, False),
        (RunMode.RUN, {"devices": 2, "strategy": "ddp"}, False),
        (None, {"devices": 2, "strategy": "ddp"}, False),
    ],
)
def test_a_sweep_refuses_processes_that_run_the_command_again(monkeypatch, mode, options, refused):
    """Without Hydra, mode is None."""
    config = SimpleNamespace(initialized=lambda: True, get=lambda: SimpleNamespace(mode=mode))
    if mode is not None:
        monkeypatch.setattr(cli, "HydraConfig", config)
    kept = ModelCheckpoint(dirpath="checkpoints", filename="last")
    trainer = L.Trainer(accelerator="cpu", logger=False, callbacks=[kept], **options)
    expected = pytest.raises(ConfigError, match=r"^trainer\.strategy: [^\n]* -m[^\n]*$")
    with expected if refused else contextlib.nullcontext():
        cli.check_trainer(trainer, SCHEDULED)

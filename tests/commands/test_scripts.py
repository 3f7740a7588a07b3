"""The commands, end to end: what a user types, and what is there afterwards."""

import json
import os
import shutil
import signal
import time
from functools import partial

import numpy as np
import pytest
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

ROWS = [
    *("linear", "prediction", "paper's hybrid to 1e-6", "sim(force, error=1e-3)"),
    *("sim(force, tol=1e-3)", "sim(force, tol=1e-6)", "Newton, tol=1e-3", "Newton, tol=1e-6"),
]


def finish(process, timeout=240):
    out, err = process.communicate(timeout=timeout)
    return process.returncode, out, err


def scalars(folder, tag):
    """Return the events of a scalar of a run, a list for each file that has it."""
    files = [EventAccumulator(str(path)).Reload() for path in sorted(folder.glob("events*"))]
    return [file.Scalars(tag) for file in files if tag in file.Tags()["scalars"]]


def waited_for(condition, seconds=90):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.2)
    return False


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The folder in which a user works."""
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def ended():
    """What the commands have said that are run once."""
    return {}


@pytest.fixture
def trained(script, tiny_training, home, ended):
    """A training run, made once: status, out, err."""
    if "train" not in ended:
        overrides = [*tiny_training, "trainer.max_epochs=2", "run=runs/first"]
        ended["train"] = script("train", *overrides, cwd=home)
    return ended["train"]


def test_training_ends_with_a_table_and_the_next_commands(trained, home):
    out = trained.out
    assert trained.status == 0, trained.err[-2000:]
    assert out.index("skipped   ") < out.index("24 accepted, 0 rejected")
    assert out.index("24 accepted, 0 rejected") < out.index("4 test loads")
    rows = json.loads((home / "runs/first/evaluation.json").read_text())
    assert [row["solver"] for row in rows] == ROWS
    assert all(name in out for name in ROWS)
    linear, prediction, *others = rows
    assert all(row["converged"] == row["loads"] == 4 for row in others)
    assert prediction["iterations"] == 0
    assert linear["iterations"] == 1
    assert all(row["errors"]["rel_L2_worst"] < 1e-4 for row in others if "1e-6" in row["solver"])
    texts = [line for line in out.splitlines() if "━" not in line]  # bars fill the terminal
    assert not [line for line in texts if len(line.rstrip()) > 100]
    assert "view.py run=runs/first" in out


def test_a_run_leaves_configuration_checkpoints_events_figure_and_case(trained, home):
    left = {path.name for path in (home / "runs/first").iterdir()}
    assert {"config.yaml", "checkpoints", "evaluation.json", "shapes.png", "worst.vtu"} <= left
    names = sorted(path.name for path in (home / "runs/first/checkpoints").iterdir())
    assert names == ["best.safetensors", "last.ckpt"]
    (data,) = (home / "datasets").iterdir()
    assert data.name.endswith("-seed0")
    assert sorted(path.name for path in home.iterdir()) == ["datasets", "runs"]


def test_evaluate_repeats_the_table_without_solving_again(trained, script, home):
    first = json.loads((home / "runs/first/evaluation.json").read_text())
    done = script("evaluate", "run=runs/first", cwd=home)
    assert done.status == 0, done.err[-2000:]
    assert "solving" not in done.out
    again = json.loads((home / "runs/first/evaluation.json").read_text())
    for one, other in zip(first, again, strict=True):
        assert one["solver"] == other["solver"]
        assert one["converged"] == other["converged"]
        assert one["iterations"] == other["iterations"]
        assert one["errors"] == pytest.approx(other["errors"], rel=1e-4, abs=1e-8)


def test_a_run_is_not_overwritten(trained, script, tiny_training, home):
    before = {path: path.stat().st_mtime_ns for path in (home / "runs/first").rglob("*.ckpt")}
    overrides = [*tiny_training, "trainer.max_epochs=3", "run=runs/first"]
    ended = script("train", *overrides, cwd=home)
    assert ended.status == 2
    assert "contains a run" in ended.err
    assert "ckpt_path=last" in ended.err
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert OmegaConf.load(home / "runs/first/config.yaml").trainer.max_epochs == 2


def test_a_run_goes_on_where_it_was_left(trained, script, home):
    shutil.copytree(home / "runs/first", home / "runs/second")
    resume = ["run=runs/second", "ckpt_path=last", "trainer.max_epochs=4"]
    ended = script("train", *resume, cwd=home)
    assert ended.status == 0, ended.err
    assert "16 of 16" not in ended.out, "no load is solved again"
    parts = scalars(home / "runs/second", "val/e_mean")
    steps = [[event.step for event in part] for part in parts]
    assert steps[0][-1] < steps[-1][0], "the second part begins after the first one"
    assert len(steps[0]) + len(steps[-1]) == 4


def test_compare_prints_the_runs_below_a_folder(trained, script, home):
    ended = script("compare", "run=runs", cwd=home)
    assert ended.status == 0, ended.err
    assert "first" in ended.out


# ------------------------------------------------------------------ processes


def online(tiny_training, *more):
    kept = [o for o in tiny_training if "data.train" not in o and "data.workers" not in o]
    small = {"batches": 4, "new_per_round": 4, "reuse": 8}
    source = [f"data.train.{key}={value}" for key, value in small.items()]
    return ["data=online", *kept, "data.workers=2", *source, *more]


@pytest.mark.slow
def test_training_on_a_stream_of_two_workers_ends_and_leaves_no_process(
    start, members, tiny_training, tmp_path
):
    process = start("train", *online(tiny_training, "trainer.max_epochs=2", "run=r"), cwd=tmp_path)
    status, _, err = finish(process)
    assert status == 0, err[-2000:]
    assert json.loads((tmp_path / "r/evaluation.json").read_text())
    assert waited_for(lambda: not members(process.pid), 5)


@pytest.fixture
def streaming(start, workers_of, tiny_training, tmp_path):
    """A run on an endless stream, with its checkpoints there; and its two workers."""
    overrides = online(tiny_training, "trainer.max_epochs=100000", "run=r")
    process = start("train", *overrides, cwd=tmp_path)
    there = waited_for(lambda: (tmp_path / "r/checkpoints/last.ckpt").exists() or process.poll())
    assert there
    assert process.poll() is None, process.communicate()[1][-2000:]

    workers = partial(workers_of, process.pid)
    assert len(workers()) == 2
    return process, workers


@pytest.mark.slow
def test_ctrl_c_ends_training_with_130_and_leaves_no_process(streaming, members):
    process, _ = streaming
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all of the group
    status, _, err = finish(process, 60)
    assert status == 130, err[-2000:]
    assert waited_for(lambda: not members(process.pid), 5)
    assert err.strip().endswith("interrupted"), err[-4000:]
    assert "Traceback" not in err, err[-4000:]


@pytest.mark.slow
def test_a_killed_worker_is_replaced_and_training_goes_on(streaming, members, tmp_path):
    process, workers = streaming
    ended, checkpoint = process.poll, tmp_path / "r/checkpoints/last.ckpt"
    for _ in range(4):  # some are killed while it waits, some while it learns
        before = workers()
        os.kill(before[0], signal.SIGKILL)
        assert waited_for(lambda b=before: len({*workers()} - {*b}) == 1 or ended() is not None)
        killed = time.time()
        assert waited_for(lambda t=killed: checkpoint.stat().st_mtime > t or ended() is not None)
        assert process.poll() is None, process.communicate()[1][-2000:]
        time.sleep(0.3)
    os.killpg(process.pid, signal.SIGINT)
    assert finish(process, 60)[0] == 130
    assert waited_for(lambda: not members(process.pid), 5)


@pytest.mark.slow
def test_a_killed_parent_leaves_no_process(streaming, members):
    process, _ = streaming
    process.kill()
    assert waited_for(lambda: not members(process.pid))


# ------------------------------------------------------------------ sweeps


def test_a_sweep_gives_each_network_the_loss_that_is_asked_for_and_a_folder(
    script, tiny_training, tmp_path
):
    sweep = ["-m", "model=fcnn,pod", "loss=mse", "trainer.max_epochs=1", "run=sweep"]
    done = script("train", *sweep, *tiny_training, cwd=tmp_path)
    assert done.status == 0, done.err[-2000:]
    judged = {}
    for folder in (path.parent for path in (tmp_path / "sweep").glob("*/config.yaml")):
        cfg = OmegaConf.load(folder / "config.yaml")
        errors = json.loads((folder / "evaluation.json").read_text())[1]["errors"]
        parts = [part._target_.rpartition(".")[2] for part in (cfg.model, cfg.loss, cfg.optimizer)]
        judged[folder.name] = parts, errors["e_mean"]
        for name in ("e_mean", "e_max", "SNR_min", "rel_L2_median", "residual"):
            (logged,) = scalars(folder, f"best/{name}")[-1]
            assert logged.value == pytest.approx(errors[name], rel=1e-5)
    assert judged.keys() == {"model-fcnn", "model-pod"}, "the key that is swept, no others"
    assert judged["model-fcnn"][0] == ["FCNN", "MSE", "AdamW"]
    assert judged["model-pod"][0] == ["PODNet", "MSE", "AdamW"]
    assert judged["model-fcnn"][1] != judged["model-pod"][1], "each run is another one"
    (journal,) = (tmp_path / "datasets").glob("*/journal.jsonl")  # they share the data set
    assert len(journal.read_text().splitlines()) == 1, "which is solved once"


@pytest.fixture
def search(script, tiny_training, tmp_path):
    """Searches for numbers of a POD network on the tiny scene; returns result and folder."""
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")

    def search(*overrides):
        sizes = [o for o in tiny_training if not o.startswith("data.batch_size")]
        short = ["hparams_search=pod", "trainer.max_epochs=1", "run=s"]
        return script("train", *short, *sizes, *overrides, cwd=tmp_path), tmp_path / "s"

    return search


def test_a_search_goes_on_after_a_trial_that_diverges_and_keeps_the_best_one(search):
    ended, folder = search("hydra.sweeper.n_trials=4", "optimizer.lr=choice(1e6,1e-2)")
    assert ended.status == 0, ended.err[-2000:]
    found = OmegaConf.load(folder / "optimization_results.yaml")
    errors = [scalars(folder / str(k), "val/e_mean")[-1][-1].value for k in range(4)]
    runs = [OmegaConf.load(folder / str(number) / "config.yaml") for number in range(4)]
    rates = [run.optimizer.lr for run in runs]
    assert set(rates[:-1]) == {1e6, 1e-2}, "both are tried, and something after the first"
    assert not np.isfinite(errors[rates.index(1e6)])
    assert found.best_value == pytest.approx(min(e for e in errors if np.isfinite(e)), rel=1e-5)
    best = runs[errors.index(min(e for e in errors if np.isfinite(e)))]
    searched = {"model.blocks", "model.rank", "optimizer.lr", "data.batch_size", "loss.relative"}
    assert set(found.best_params) == searched, "the width is given on the command line"
    for key, value in found.best_params.items():
        assert OmegaConf.select(best, key) == pytest.approx(value)
    assert best.model.width == 16


def test_a_search_without_validation_ends_with_one_line(search):
    ended, folder = search("hydra.sweeper.n_trials=2", "+trainer.limit_val_batches=0")
    assert ended.status == 2
    assert "error: trainer.limit_val_batches: no validation error is stored" in ended.err
    assert len(list(folder.glob("*/config.yaml"))) == 1, "the first trial tells"

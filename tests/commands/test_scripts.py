"""The commands, end to end: what a user types, and what is there afterwards."""

import itertools
import json
import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.hparams import api_pb2, get_experiment, list_session_groups
from tensorboard.plugins.hparams.backend_context import Context

ROWS = [
    *("linear", "prediction", "paper's hybrid to 1e-6", "sim(force, error=1e-3)"),
    *("sim(force, tol=1e-3)", "sim(force, tol=1e-6)", "Newton, tol=1e-3", "Newton, tol=1e-6"),
]


def finish(process, timeout=240):
    out, err = process.communicate(timeout=timeout)
    return process.returncode, out, err


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
    steps = []
    for path in sorted((home / "runs/second").glob("events*")):
        events = EventAccumulator(str(path))
        events.Reload()
        if "val/e_mean" in events.Tags()["scalars"]:
            steps.append([event.step for event in events.Scalars("val/e_mean")])
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
def streaming(start, members, tiny_training, tmp_path):
    """A run on an endless stream, with its checkpoints there; and its two workers."""
    overrides = online(tiny_training, "trainer.max_epochs=100000", "run=r")
    process = start("train", *overrides, cwd=tmp_path)
    there = waited_for(lambda: (tmp_path / "r/checkpoints/last.ckpt").exists() or process.poll())
    assert there
    assert process.poll() is None, process.communicate()[1][-2000:]

    def workers():
        found = []
        for pid in members(process.pid):
            try:
                line = Path(f"/proc/{pid}/cmdline").read_text()
            except OSError:
                continue
            if "spawn_main" in line:
                found.append(pid)
        return found

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
    checkpoint = tmp_path / "r/checkpoints/last.ckpt"
    for _ in range(4):  # some are killed while it waits, some while it learns
        before = workers()
        os.kill(before[0], signal.SIGKILL)
        waited_for(lambda b=before: len(set(workers()) - set(b)) == 2 or process.poll() is not None)
        killed = time.time()
        waited_for(lambda t=killed: checkpoint.stat().st_mtime > t or process.poll() is not None)
        assert process.poll() is None, process.communicate()[1][-2000:]
        time.sleep(0.3)
    os.killpg(process.pid, signal.SIGINT)
    assert finish(process, 60)[0] == 130
    assert waited_for(lambda: not members(process.pid), 5)


@pytest.mark.slow
def test_a_killed_parent_leaves_no_process(streaming, members):
    process, _ = streaming
    process.kill()
    assert waited_for(lambda: not members(process.pid), 2)


# ------------------------------------------------------------------ sweeps


def configurations(folder):
    """Return those of the runs below a folder, by the last names of network, loss and optimiser."""
    seen = {}
    for path in folder.glob("*/config.yaml"):
        cfg = OmegaConf.load(path)
        parts = (cfg.model, cfg.loss, cfg.optimizer)
        seen[tuple(part._target_.rpartition(".")[2] for part in parts)] = path.parent
    return seen


@pytest.fixture
def swept(script, tiny_training, tmp_path_factory, ended):
    """Where a sweep over networks and losses ran, once."""
    if "sweep" not in ended:
        home = tmp_path_factory.mktemp("swept")
        sweep = ["-m", "model=fcnn,pod", "loss=mse,lr_star", "trainer.max_epochs=1", "run=sweep"]
        done = script("train", *sweep, *tiny_training, cwd=home)
        assert done.status == 0, done.err[-2000:]
        ended["sweep"] = home
    return ended["sweep"]


def test_a_sweep_over_networks_gives_each_the_loss_that_is_asked_for_and_a_folder(swept):
    runs = configurations(swept / "sweep")
    assert set(runs) == {
        ("FCNN", "MSE", "AdamW"),
        ("FCNN", "LrStar", "AdamW"),
        ("PODNet", "MSE", "AdamW"),
        ("PODNet", "LrStar", "AdamW"),
    }
    pairs = itertools.product(("mse", "lr_star"), ("fcnn", "pod"))
    names = {f"loss-{loss}_model-{model}" for loss, model in pairs}
    assert {folder.name for folder in runs.values()} == names, "the keys that are swept, no others"
    judged = {json.loads((folder / "evaluation.json").read_text())[1]["errors"]["e_mean"]
              for folder in runs.values()}  # fmt: skip
    assert len(judged) == 4, "each run is another one"
    assert len(list((swept / "datasets").iterdir())) == 1, "they share the data set"
    (journal,) = (swept / "datasets").glob("*/journal.jsonl")
    assert len(journal.read_text().splitlines()) == 1, "which is solved once"


def test_the_hparams_tab_shows_the_runs_of_a_sweep_side_by_side(swept):
    """What TensorBoard's own reader hands to the tab: columns, then a line for each run."""
    runs = EventMultiplexer()
    runs.AddRunsFromDirectory(str(swept / "sweep"))
    runs.Reload()
    provider = MultiplexerDataProvider(runs, str(swept / "sweep"))
    backend = Context(TBContext(data_provider=provider))
    requested = RequestContext(), backend, ""
    columns = get_experiment.Handler(*requested, api_pb2.GetExperimentRequest()).run()
    request = api_pb2.ListSessionGroupsRequest(
        start_index=0,
        slice_size=10,
        allowed_statuses=[api_pb2.STATUS_SUCCESS],
        col_params=[
            *({"hparam": info.name} for info in columns.hparam_infos),
            *({"metric": info.name} for info in columns.metric_infos),
        ],
    )
    lines = list_session_groups.Handler(*requested, request).run().session_groups

    names = {info.name for info in columns.hparam_infos}
    assert {"model", "loss", "optimizer.lr", "model.layers", "model.rank", "young"} <= names
    assert not [name for name in names if "_" in (name[0], name[-1]) or "callbacks" in name]
    metrics = {info.name.tag for info in columns.metric_infos}
    judged = ("e_mean", "e_max", "SNR_min", "rel_L2_median", "residual")
    assert {f"best/{name}" for name in judged} <= metrics

    assert len(lines) == 4
    folders = configurations(swept / "sweep")
    for line in lines:
        shown = {name: value.string_value for name, value in line.hparams.items()}
        errors = {value.name.tag: value.value for value in line.metric_values}
        folder = folders[shown["model"], shown["loss"], shown["optimizer"]]
        rows = json.loads((folder / "evaluation.json").read_text())
        for name in judged:
            assert errors[f"best/{name}"] == pytest.approx(rows[1]["errors"][name], rel=1e-5)
        assert line.hparams["model.width"].number_value == 16
        assert ("model.rank" in line.hparams) == (shown["model"] == "PODNet")
        assert ("model.layers" in line.hparams) == (shown["model"] == "FCNN")


@pytest.fixture
def search(script, tiny_training, tmp_path):
    """Searches for numbers of a POD network on the tiny scene; returns result and folder."""
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")

    def search(*overrides):
        sizes = [o for o in tiny_training if not o.startswith("data.batch_size")]
        short = ["hparams_search=pod", "trainer.max_epochs=1", "run=s"]
        return script("train", *short, *sizes, *overrides, cwd=tmp_path), tmp_path / "s"

    return search


def validated(folder):
    """Return the validation e_mean of a run of one epoch."""
    for path in folder.glob("events*"):
        events = EventAccumulator(str(path))
        events.Reload()
        if "val/e_mean" in events.Tags()["scalars"]:
            return events.Scalars("val/e_mean")[-1].value
    raise AssertionError(f"{folder} was not validated")


def test_a_search_goes_on_after_a_trial_that_diverges_and_keeps_the_best_one(search):
    ended, folder = search("hydra.sweeper.n_trials=4", "optimizer.lr=choice(1e6,1e-2)")
    assert ended.status == 0, ended.err[-2000:]
    found = OmegaConf.load(folder / "optimization_results.yaml")
    errors = [validated(folder / str(number)) for number in range(4)]
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

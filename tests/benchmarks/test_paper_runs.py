"""The runs of the paper: what is planned is valid, what is finished is not trained again."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from benchmarks import paper, results
from benchmarks.paper import Run, State
from benchmarks.results import EXPERIMENTS
from dpl.commands import dry_run
from dpl.config import CONF

ROOT = Path(__file__).parents[2]
SHIPPED = OmegaConf.to_container(OmegaConf.load(ROOT / "benchmarks/conf/paper.yaml"))
PLAN = {
    "one": {
        "experiments": ["beam_svk", "propeller_nh"],
        "runs": {"fcnn": ["model=fcnn", "trainer.max_epochs=60"], "pod": ["experiment=paper"]},
    },
    "losses": {
        "experiments": ["beam_nh_loss"],
        "folder": "losses",
        "runs": {"fcnn": ["model=fcnn"]},
        "sweep": {"loss": ["mse", "energy"], "seed": [0, 1]},
    },
}
SIZES = {"all": ["trainer.max_epochs=1"], "beam_svk": ["mesh.nodes=[5,3,3]"]}


def planned(groups=None, more=()):
    return {run.path: run for run in paper.planned(PLAN, groups, SIZES, more)}


# ------------------------------------------------------------------ the plan


def test_each_run_is_planned_for_each_experiment_and_value():
    runs = planned()
    assert list(runs) == [
        *("beam_svk/fcnn", "beam_svk/pod", "propeller_nh/fcnn", "propeller_nh/pod"),
        *(f"losses/fcnn-{loss}-{seed}" for loss in ("mse", "energy") for seed in (0, 1)),
    ]
    assert list(planned(["losses"])) == list(runs)[4:]
    assert {"loss=energy", "seed=1"} <= set(runs["losses/fcnn-energy-1"].options)


def test_a_recipe_is_combined_with_the_experiment_and_sizes_replace_options():
    runs = planned(more=["data.train=8"])
    assert runs["propeller_nh/pod"].options == (
        "experiment=[propeller_nh,paper]",
        "trainer.max_epochs=1",
        "data.train=8",
    )
    assert "mesh.nodes=[5,3,3]" in runs["beam_svk/fcnn"].options
    assert sum("max_epochs" in one for one in runs["beam_svk/fcnn"].options) == 1


@pytest.fixture
def composed(tmp_path, monkeypatch):
    """Composes and checks the training of a run as its command does; returns the configuration."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DPL_CONF", str(CONF))

    def composed(run):
        _, arguments = paper.arguments(run, Path("runs"), State.MISSING)
        line = dry_run.arguments_of(arguments, "train", CONF)
        GlobalHydra.instance().clear()
        with dry_run.initialized(line):
            return dry_run.check(line)

    return composed


def assert_valid(run, composed):
    cfg = composed(run)
    assert str(cfg.run) == f"runs/{run.path}"
    for option in run.options:
        key, _, value = option.partition("=")
        if key.startswith(("trainer.", "data.train", "model.width")):
            assert OmegaConf.select(cfg, key) == yaml.safe_load(value), (run.path, option)


def shipped(scale):
    return paper.planned(SHIPPED["plan"], None, SHIPPED["scales"][scale]["train"])


def test_the_last_run_of_each_group_is_a_valid_training(composed):
    last = {run.group: run for run in shipped("small")}
    assert set(last) == set(SHIPPED["plan"])
    for run in last.values():
        assert_valid(run, composed)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("scale", SHIPPED["scales"])
def test_every_run_of_the_shipped_plan_is_a_valid_training(scale, composed):
    """One seed and one experiment of each."""
    every = {(run.group, run.path.split("/")[1]): run for run in shipped(scale)}
    for run in every.values():
        if not run.path.endswith(("-1", "-2")):
            assert_valid(run, composed)


def test_the_shipped_plan_has_all_experiments_losses_and_three_seeds():
    runs = paper.planned(SHIPPED["plan"], SHIPPED["groups"], {})
    folders = {run.path.split("/")[0] for run in runs}
    assert folders == {*EXPERIMENTS, "losses"}
    losses = [run for run in runs if run.path.startswith("losses/")]
    assert len(losses) == 7 * 3
    assert all("model.base=linear" in run.options for run in losses)


# ------------------------------------------------------------------ states


def begin(folder, target="dpl.models.FCNN"):
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "config.yaml").write_text(f"model:\n  _target_: {target}\n")


def test_states_follow_from_the_folder_of_a_run(tmp_path):
    run = Run("one", "beam_svk/fcnn", ("model=fcnn",))
    folder = tmp_path / run.path
    paper.keep_options(run, tmp_path)
    assert paper.state(run, tmp_path) == State.MISSING
    begin(folder)
    assert paper.state(run, tmp_path) == State.INTERRUPTED
    (folder / "evaluation.json").write_text("[]")
    assert paper.state(run, tmp_path) == State.FINISHED, "trained by hand"
    paper.keep_options(run, tmp_path)
    assert paper.state(run, tmp_path) == State.FINISHED
    other = Run("one", run.path, ("model=cnn",))
    assert paper.state(other, tmp_path) == State.OTHER_OPTIONS


def test_trainings_are_resumed_and_fitted_models_are_evaluated(tmp_path):
    run = Run("one", "beam_svk/fcnn", ("model=fcnn",))
    folder = tmp_path / run.path
    script, arguments = paper.arguments(run, tmp_path, State.MISSING)
    assert (script, arguments) == ("train", ["model=fcnn", f"run={folder}", "ckpt_path=last"])
    begin(folder)
    (folder / "checkpoints/last.ckpt").touch()
    assert paper.arguments(run, tmp_path, State.INTERRUPTED)[0] == "train"
    fitted = Run("one", "beam_svk/unrolled", ("model=unrolled",))
    begin(tmp_path / fitted.path, "dpl.models.Unrolled")
    assert paper.arguments(fitted, tmp_path, State.INTERRUPTED)[0] == "train"
    (tmp_path / fitted.path / "checkpoints/last.ckpt").touch()
    assert paper.arguments(fitted, tmp_path, State.INTERRUPTED) == (
        "evaluate",
        [f"run={tmp_path / fitted.path}"],
    )


# ------------------------------------------------------------------ processes


PARENT = """
import sys
from pathlib import Path
from benchmarks import subcommands
subcommands.SCRIPTS = Path(sys.argv[1])
try:
    subcommands.run_script("waits", [])
except KeyboardInterrupt:
    print("parent saw it")
    sys.exit(130)
"""
CHILD = """
import sys, time
from pathlib import Path
try:
    print("started", flush=True)
    time.sleep(60)
except KeyboardInterrupt:
    time.sleep(0.3)
    print("saved", flush=True)
    sys.exit(130)
"""


def test_an_interruption_lets_the_script_end_first(environment, tmp_path):
    (tmp_path / "waits.py").write_text(CHILD)
    process = subprocess.Popen(
        [sys.executable, "-c", PARENT, str(tmp_path)],
        env=environment(),
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout.readline() == "started\n"
    os.killpg(process.pid, signal.SIGINT)  # as Ctrl-C in a terminal: to the whole group
    out, _ = process.communicate(timeout=30)
    assert process.returncode == 130
    assert out.splitlines() == ["saved", "parent saw it"]


# ------------------------------------------------------------------ tables


def test_losses_are_medians_over_seeds():
    runs = {
        f"linear-{loss}-{seed}": [factor * (seed + 1)] * 8
        for loss, factor in (("mse", 1.0), ("energy_norm", 10.0))
        for seed in range(3)
    }
    rows = results.loss_rows({**runs, "mine": [5.0] * 8})
    assert [(row.runs, row.seeds, row.e_mean) for row in rows] == [
        ("linear-mse", 3, 2.0),
        ("linear-energy_norm", 3, 20.0),
        ("mine", 1, 5.0),
    ]


def test_numbers_of_a_run_are_those_of_its_evaluation(tmp_path):
    errors = {"e_mean": 1.0, "e_max": 2.0, "SNR_min": 3.0, "rel_L2_median": 4.0}
    rows = [
        {"solver": "prediction", "errors": errors, "iterations": 0.0},
        {"solver": "paper's hybrid to 1e-6", "errors": {}, "iterations": 5.5},
    ]
    (tmp_path / "evaluation.json").write_text(json.dumps(rows))
    found = results.loss_numbers(tmp_path)
    assert found[:4] == [1.0, 2.0, 3.0, 4.0]
    assert found[4] != found[4], "unknown"
    assert found[6] == 5.5


# ------------------------------------------------------------------ the commands


def test_a_run_of_other_options_is_refused_before_anything_starts(script, tmp_path):
    begin(tmp_path / "runs/small/beam_nh_loss/fcnn_full_mse")
    other = Run("full", "beam_nh_loss/fcnn_full_mse", ("model=cnn",))
    paper.keep_options(other, tmp_path / "runs/small")
    ended = script("paper", "scale=small", "groups=[full]", cwd=tmp_path)
    assert ended.status == 2
    assert "runs/small/beam_nh_loss/fcnn_full_mse was trained with other options" in ended.err


def test_all_results_without_runs_name_what_is_missing(script, tmp_path):
    ended = script("results", "name=all", "folder=out", cwd=tmp_path)
    assert ended.status == 0, ended.err
    for name in (*EXPERIMENTS, "losses", "convergence"):
        assert f"left out: {name}" in ended.out


TINY = [
    "scale=small",
    "groups=[tiny,losses]",
    "+plan.tiny={experiments:[beam_svk],runs:{unrolled:['model=unrolled'],"
    "fcnn:['model=fcnn','model.width=16','loss=mse']}}",
    "plan.losses.sweep.loss=[mse]",
    "plan.losses.sweep.seed=[0]",
]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_one_command_trains_resumes_and_writes_all_tables(start, tmp_path):
    """Interrupted in the first run, started again, and a third time with nothing left to train."""
    root = tmp_path / "runs/small"
    first = start("paper", *TINY, cwd=tmp_path)
    end = time.monotonic() + 300
    while not (root / "beam_svk/unrolled/config.yaml").is_file() and time.monotonic() < end:
        assert first.poll() is None, first.communicate()
        time.sleep(0.1)
    first.send_signal(signal.SIGINT)
    _, err = first.communicate(timeout=300)
    assert first.returncode == 130, err[-2000:]
    second = start("paper", *TINY, cwd=tmp_path)
    out, err = second.communicate(timeout=600)
    assert second.returncode == 0, (out + err)[-3000:]
    results = root / "results"
    assert {path.stem for path in results.glob("*.csv")} == {
        *("beam_svk", "hybrid_newton", "losses"),
    }
    assert {path.stem for path in results.glob("*.png")} == {"beam_svk", "hybrid_newton"}
    assert "left out: propeller_nh: no finished run" in out
    third = start("paper", *TINY, "tables=false", cwd=tmp_path)
    out, _ = third.communicate(timeout=120)
    assert third.returncode == 0
    assert "3 finished" in out

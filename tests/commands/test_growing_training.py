"""Training on a data set that grows: `train.py model=unrolled data=growing`."""

import json

import pytest
from omegaconf import OmegaConf

from dpl.config import run_folder
from dpl.training import checkpoints

MODEL = ["model.rank=12", "model.cells=8", "model.stages=1"]
SIZES = ["data.val=8", "data.test=4", "data.workers=0", "data.folder=data"]
SMALL = ["data.train.max_train=20", "data.train.error=1e-9"]
RUN = ["model=unrolled", "data=growing", "logger=csv", "run=run"]


@pytest.fixture
def train(script, tiny, tmp_path):
    """Return a function that runs the command in a temporary folder."""

    def train(*options):
        return script("train", *tiny, *options, cwd=tmp_path)

    return train


def test_a_run_fits_until_its_end_and_is_resumed_with_more_loads(train, tmp_path):
    done = train(*RUN, *MODEL, *SIZES, "data.train.max_train=100", "data.train.error=1e-9")
    assert not done.status, done.err
    assert "64 loads, " in done.out
    assert "data.train.max_train = 100 reached" in done.out
    weights = checkpoints.read(tmp_path / "run/checkpoints/last.ckpt")
    assert [point[0] for point in weights["DataModule"]["points"]] == [64, 100]
    header, *rows = (tmp_path / "run/csv/metrics.csv").read_text().splitlines()
    curve = [row for row in rows if row.split(",")[header.split(",").index("step")] == "100"]
    assert "learning_curve/e_mean" in header
    assert curve, "the step of the learning curve is the number of loads"
    assert run_folder.load(tmp_path / "run").surrogate.net.is_fitted
    assert (tmp_path / "run/evaluation.json").exists()
    resumed = train("run=run", "ckpt_path=last", "data=growing", "data.train.max_train=150")
    assert not resumed.status, resumed.err
    assert "64 loads, " not in resumed.out
    assert "150 loads, " in resumed.out
    finished = train("run=run", "ckpt_path=last", "data=growing", "data.train.error=1.0")
    assert not finished.status, finished.err
    assert " loads, " not in finished.out.partition("test loads")[0], "no further fit"
    sessions = (tmp_path / "data/journal.jsonl").read_text().splitlines()
    assert sum(json.loads(line)["loads"] for line in sessions) == 150 + 8 + 4


TERMINATING = """
import signal

from dpl.training import WorstCasePlots


class Terminate(WorstCasePlots):
    def on_validation_epoch_end(self, trainer, module):
        signal.raise_signal(signal.SIGTERM)
"""


def test_sigterm_ends_a_growing_training_with_143_and_the_command_that_resumes_it(
    train, tmp_path, monkeypatch
):
    (tmp_path / "terminating.py").write_text(TERMINATING)
    monkeypatch.syspath_prepend(str(tmp_path))
    stop = "+callbacks.stop={_target_: terminating.Terminate}"
    ended = train(*RUN, *MODEL, *SIZES, "data.train.max_train=100", "data.train.error=1e-9", stop)
    assert ended.status == 143, ended.err
    assert "Traceback" not in ended.err
    assert "run=run ckpt_path=last" in ended.err
    weights = checkpoints.read(tmp_path / "run/checkpoints/last.ckpt")
    assert weights["DataModule"]["points"][0][0] == 64


def test_the_set_of_a_growing_run_serves_runs_of_other_sizes(train, tmp_path):
    assert not train(*RUN, *MODEL, *SIZES, *SMALL).status
    again = train("model=unrolled", "data.train=20", "run=other", "logger=none", *MODEL, *SIZES)
    assert not again.status, again.err
    assert "20 train, 8 val, 4 test; 0 of them to be solved" in again.out
    weights = [
        checkpoints.read(tmp_path / run / "checkpoints/best.safetensors")["state_dict"]
        for run in ("run", "other")
    ]
    assert all(weights[0][name].equal(weights[1][name]) for name in weights[0])
    cfg, surrogate = run_folder.load_run(tmp_path / "run")
    more = OmegaConf.merge(cfg, {"data": {"train": 24}})
    assert len(run_folder.load_data(more, surrogate.scene).samples("train").force) == 24
    assert cfg.data.train == 20
    assert len(run_folder.load_data(cfg, surrogate.scene).snapshots().force) == 20


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("model=fcnn", "error: data=growing needs a model that is fitted"),
        ("data.train=auto", "data.train = 'auto' must be a whole number or a call that returns a"),
        ("data.train.error=0", "data: error = 0 must be above 0"),
        ("data.train.minutes=-1", "data: minutes = -1 must be above 0 [min], or null"),
        ("data.train.max_train=0", "data: max_train = 0 must lie between 1 and 10,000,000"),
    ],
)
def test_values_are_refused_in_one_line_before_any_solve(train, tmp_path, line, message):
    """The default model, unrolled, is fitted."""
    refused = train("data=growing", "data.folder=data", line)
    assert refused.status == 2
    assert message in refused.err
    assert refused.err.count("\n") == 1
    assert not (tmp_path / "data").exists()

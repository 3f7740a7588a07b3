"""Laws of averaged weights, early stopping and time limits of a training."""

import hashlib
import shlex
import signal
import time

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import Timer

from dpl import config
from dpl.models import FCNN
from dpl.training import (
    MSE,
    AveragedWeights,
    Surrogate,
    metrics,
    schedules,
    warmup_cosine,
)
from dpl.training.checkpoints import read

QUIET = ["callbacks.progress_bar._target_=lightning.pytorch.callbacks.TQDMProgressBar"]


class Record(L.Callback):
    """Keeps the weights after every step and those of every validation."""

    def __init__(self):
        self.weights, self.validated, self.rates = [], [], []

    def on_train_batch_end(self, trainer, module, *args, **kwargs):
        self.weights.append(flat(module))
        self.rates.append(trainer.optimizers[0].param_groups[0]["lr"])

    def on_validation_epoch_start(self, trainer, module):
        self.validated.append(flat(module))


def flat(module):
    return torch.cat([p.detach().flatten() for p in module.parameters()])


def fit(scene, data, tmp_path, *callbacks, scheduler=None, **options):
    torch.manual_seed(0)
    surrogate = Surrogate(FCNN(scene, width=8), MSE(), scene, scheduler=scheduler)
    record = Record()
    quiet = {"enable_progress_bar": False, "enable_model_summary": False, "logger": False}
    trainer = L.Trainer(
        accelerator="cpu", callbacks=[*callbacks, record], default_root_dir=tmp_path,
        num_sanity_val_steps=0, enable_checkpointing=False, **quiet, **options,
    )  # fmt: skip
    trainer.fit(surrogate, datamodule=data)
    return surrogate, trainer, record


def digest(value):
    """Return the SHA-256 of plain data with tensors."""
    found = hashlib.sha256()
    for path, leaf in torch.utils._pytree.tree_flatten_with_path(value)[0]:
        found.update(f"{path}".encode())
        found.update(leaf.numpy().tobytes() if torch.is_tensor(leaf) else repr(leaf).encode())
    return found.hexdigest()


def averages(start, weights, decay):
    """Return the averages after each step by their definition."""
    found, average = [], start
    for n, now in enumerate(weights, start=1):
        d = min(decay, (1 + n) / (10 + n))
        average = d * average + (1 - d) * now
        found.append(average)
    return found


@pytest.mark.parametrize("decay", [0.0, 0.5, 0.999])
def test_the_average_of_the_weights_is_validated_and_remains(scene, data, tmp_path, decay):
    torch.manual_seed(0)
    start = flat(Surrogate(FCNN(scene, width=8), MSE(), scene))
    average = AveragedWeights(decay=decay)
    surrogate, _, record = fit(scene, data, tmp_path, average, max_epochs=3)
    expected = averages(start, record.weights, decay)
    steps = len(record.weights) // 3
    for k, validated in enumerate(record.validated, start=1):
        assert torch.allclose(validated, expected[k * steps - 1], rtol=1e-5, atol=1e-7)
    assert torch.allclose(flat(surrogate), expected[-1], rtol=1e-5, atol=1e-7)
    assert decay == 0 or not torch.allclose(flat(surrogate), record.weights[-1], rtol=1e-5)


def test_the_average_does_not_change_the_training(scene, data, tmp_path):
    _, _, plain = fit(scene, data, tmp_path, max_epochs=3)
    _, _, averaged = fit(scene, data, tmp_path, AveragedWeights(decay=0.9), max_epochs=3)
    assert torch.equal(torch.stack(plain.weights), torch.stack(averaged.weights))


@pytest.mark.parametrize("decay", [-0.1, 1.0])
def test_a_decay_out_of_range_raises_an_error(decay):
    with pytest.raises(ValueError, match="decay ="):
        AveragedWeights(decay=decay)


# ------------------------------------------------------------------ the command


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("habits")


@pytest.fixture
def train(script, tiny_training, home):
    """Trains a run in a folder of this module with a shared data set, without pictures."""

    def train(name, *overrides, status=0, model=("experiment=paper", "model.width=8"), log="none"):
        kept = [one for one in tiny_training if not one.startswith("model.")]
        common = [*kept, *model, *QUIET, f"logger={log}", f"data.folder={home}/data", f"run={name}"]
        ended = script("train", *common, *overrides, cwd=home)
        assert ended.status == status, ended.err[-2000:]
        return ended

    return train


def checkpoint(home, name, file="last.ckpt"):
    return read(home / name / "checkpoints" / file)


EMA = ["callbacks=ema", "callbacks.averaged_weights.decay=0.8"]


def test_the_best_weights_are_the_average_that_was_validated(train, home):
    """They predict the validation loads with the error that selected them."""
    train("ema", *EMA, "trainer.max_epochs=4")
    last, best = checkpoint(home, "ema"), checkpoint(home, "ema", "best.safetensors")
    weights = last["callbacks"]["AveragedWeights"]["weights"]
    assert last["callbacks"]["AveragedWeights"]["steps"] == last["global_step"] == 8
    name = next(iter(weights))
    assert not torch.equal(last["state_dict"][name], weights[name])
    if best["epoch"] == last["epoch"]:
        assert torch.equal(best["state_dict"][name], last["state_dict"][name])
    cfg, surrogate = config.load_run(home / "ema")
    samples = config.load_data(cfg, surrogate.scene).samples("val")
    with torch.no_grad():
        prediction = surrogate.predict(samples.load)
    error = metrics.errors_of(surrogate.scene.problem, prediction, samples)["e_mean"]
    key = next(key for key in last["callbacks"] if key.startswith("BestWeights"))
    assert error == pytest.approx(float(last["callbacks"][key]["best_model_score"]), rel=1e-4)
    ended = train("ema", "trainer.max_epochs=5", "ckpt_path=last", status=2)  # lacks its callback
    assert ended.err.strip().splitlines()[-1].endswith("add callbacks=ema")


def test_early_stopping_ends_a_training(train, home):
    """No error falls by 10: the second validation without improvement ends the training."""
    stop = ["callbacks=early_stopping", "callbacks.early_stopping.min_delta=10"]
    stop += ["callbacks.early_stopping.patience=2", "scheduler=null"]
    train("stop", *stop, "trainer.max_epochs=9")
    assert checkpoint(home, "stop")["epoch"] == 2


def test_callbacks_and_end_of_gradient_descent_leave_a_fitted_model_alone(train, home):
    model = ["model=unrolled", "model.rank=12", "model.cells=4", "model.stages=1", "data.train=16"]
    for name, options in (("a", ["callbacks=early_stopping", "trainer.max_epochs=-1"]), ("b", EMA)):
        train(name, *options, model=model)
    states = [digest(checkpoint(home, name)["state_dict"]) for name in "ab"]
    assert states[0] == states[1]


# ------------------------------------------------------------------ end and continuation


@pytest.mark.parametrize(
    ("options", "validations"),
    [
        ({"max_steps": 8, "check_val_every_n_epoch": 5}, 1),
        ({"max_steps": 8, "check_val_every_n_epoch": 1}, 3),
        ({"max_steps": 11, "check_val_every_n_epoch": None, "val_check_interval": 4}, 3),
        ({"max_epochs": 3, "check_val_every_n_epoch": None, "val_check_interval": 4}, 3),
        ({"max_epochs": 2, "val_check_interval": 2}, 3),
        ({"max_epochs": 3, "check_val_every_n_epoch": 2}, 2),
    ],
)
def test_the_last_weights_are_validated(scene, data, tmp_path, options, validations):
    """Three steps an epoch: epochs, intervals and the last step end together or apart."""
    record = fit(scene, data, tmp_path, **options)[2]
    assert len(record.validated) == validations
    assert torch.equal(record.validated[-1], record.weights[-1])


INTERRUPTING = """
import lightning as L


class Interrupt(L.Callback):
    '''Ctrl-C in the second epoch.'''

    def on_train_epoch_start(self, trainer, module):
        if trainer.current_epoch == 1:
            raise KeyboardInterrupt
"""


def test_the_printed_command_resumes_the_callbacks_and_the_logger(train, script, home, monkeypatch):
    (home / "interrupting.py").write_text(INTERRUPTING)
    monkeypatch.syspath_prepend(str(home))
    handler = signal.getsignal(signal.SIGINT)
    stop = "+callbacks.stop={_target_: interrupting.Interrupt}"
    try:
        ended = train("torn", *EMA, stop, "trainer.max_epochs=3", status=130, log="csv")
    finally:
        signal.signal(signal.SIGINT, handler)  # Lightning ignores it after the first Ctrl-C
    line = next(one for one in ended.err.splitlines() if one.startswith("to resume: "))
    words = shlex.split(line)[-7:]
    assert words[:2] == ["run=torn", "ckpt_path=last"]
    assert set(words[2:]) == {*EMA, *QUIET, "logger=csv", stop}
    again = script("train", *(one for one in words if one != stop), "trust=true", cwd=home)
    assert again.status == 0, again.err
    assert (home / "torn" / "csv" / "metrics.csv").is_file()
    assert checkpoint(home, "torn")["callbacks"]["AveragedWeights"]["steps"] == 6


# ------------------------------------------------------------------ time limits


class Clock:
    """Monotonic clock on which each training step takes a second."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


class Tick(L.Callback):
    def __init__(self, clock):
        self.clock = clock

    def on_train_batch_start(self, *args, **kwargs):
        self.clock.now += 1.0


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock)
    return clock


@pytest.mark.parametrize("max_epochs", [-1, 1000])
def test_the_schedule_ends_with_the_time(scene, data, tmp_path, clock, max_epochs):
    """Three steps an epoch, 12 s of one step each: the rate is that of the elapsed time."""
    options = {"max_epochs": max_epochs, "max_time": {"seconds": 12}}
    _, trainer, record = fit(scene, data, tmp_path, Tick(clock), scheduler=warmup_cosine, **options)
    assert len(record.rates) == 12
    steps = schedules.total_steps(trainer)
    expected = warmup_cosine(
        torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1e-3), total_steps=steps
    ).lr_lambdas[0]
    for second, rate in enumerate(record.rates, start=1):
        assert rate == pytest.approx(1e-3 * expected(steps * second // 12), abs=1e-9)
    assert record.rates[-1] == pytest.approx(0, abs=1e-9)


def test_the_schedule_ignores_a_time_limit_that_is_far(scene, data, tmp_path, clock):
    plain = fit(scene, data, tmp_path, scheduler=warmup_cosine, max_epochs=3)[2]
    late = fit(
        scene, data, tmp_path, Tick(clock), scheduler=warmup_cosine, max_epochs=3,
        max_time={"hours": 1},
    )[2]  # fmt: skip
    assert late.rates == plain.rates


def test_a_time_limit_ends_within_an_epoch_that_is_validated(scene, data, tmp_path, clock):
    """The limit is met in the second of the three steps of the third epoch."""
    record = fit(
        scene, data, tmp_path, Tick(clock), max_epochs=100, max_time={"seconds": 8},
        check_val_every_n_epoch=10,
    )[2]  # fmt: skip
    assert len(record.weights) == 8
    assert len(record.validated) == 1
    assert torch.equal(record.validated[0], record.weights[-1])


def test_a_schedule_that_does_not_end_with_the_time_is_refused(train):
    limit = ["trainer.max_epochs=-1", "trainer.max_time=00:01:00", "~scheduler.warmup"]
    other = ["scheduler._target_=torch.optim.lr_scheduler.OneCycleLR", "+scheduler.max_lr=1e-3"]
    ended = train("invalid", *limit, *other, status=2)
    assert "OneCycleLR does not follow trainer.max_time" in ended.err
    assert "Traceback" not in ended.err


@pytest.mark.parametrize(
    ("limit", "seconds"), [("{minutes:5}", 300), ("00:00:07", 7), ("01:00:00:00", 86400)]
)
def test_a_time_limit_is_a_text_or_units(compose, limit, seconds):
    cfg = compose("folder=.", f"trainer.max_time={limit}", "logger=none", command="train")
    config.check(cfg)
    (timer,) = (one for one in config.build_trainer(cfg).callbacks if isinstance(one, Timer))
    assert timer._duration == seconds

"""Surrogate: units, scales, logged metrics, checkpoints and exact resumption."""

import random
from pathlib import Path

import lightning as L
import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import nn

from dpl.data import DataModule, Stream
from dpl.fem import Load
from dpl.models import FCNN
from dpl.models.linear_base import sampled_solutions
from dpl.training import (
    MSE,
    AtomicCheckpointIO,
    AveragedWeights,
    BlendedLoss,
    LrPlus,
    Surrogate,
    warmup_cosine,
)  # fmt: skip
from dpl.training.checkpoints import random_states, read, set_random_states
from dpl.training.predictors import scales

CONF = Path(__file__).parents[2] / "conf"
METRICS = {
    "e_mean", "e_max", "SNR_min", "SNR_min_printed",
    "rel_L2_median", "rel_L2_worst", "residual", "min_det_F",
}  # fmt: skip


def surrogate(scene, loss=None, *, seed=0, lr=1e-3, scheduler=warmup_cosine):
    torch.manual_seed(seed)
    return Surrogate(
        FCNN(scene, width=16),
        loss or MSE(),
        scene,
        optimizer=lambda parameters: torch.optim.AdamW(parameters, lr=lr),
        scheduler=scheduler,
    )


def trainer(folder, *callbacks, **options):
    defaults = {"accelerator": "cpu", "logger": False, "num_sanity_val_steps": 0}
    quiet = {"enable_progress_bar": False, "enable_model_summary": False}
    nodes = OmegaConf.load(CONF / "callbacks" / "none.yaml").values()
    checkpoints = [instantiate(node, dirpath=str(folder)) for node in nodes]
    return L.Trainer(
        callbacks=[*checkpoints, *callbacks],
        plugins=[AtomicCheckpointIO()],
        default_root_dir=folder,
        **{**defaults, **quiet, **options},
    )


class StopAfter(L.Callback):
    """Stops a run early, like a limit of the wall time."""

    def __init__(self, epochs):
        self.epochs = epochs

    def on_train_epoch_end(self, trainer, module):
        trainer.should_stop |= trainer.current_epoch + 1 >= self.epochs


def weights(module):
    return {name: value.clone() for name, value in module.state_dict().items()}


def identical(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)


# ------------------------------------------------------------------ the border to SI units


def test_predictions_are_metres_from_newtons(scene, batch):
    module = surrogate(scene).eval()
    newtons = batch.force * (batch.young * scene.length**2)[:, None, None]
    with torch.no_grad():
        metres, ratio = module(newtons, batch.young), module.predict(batch.load)
    assert torch.allclose(metres, scene.length * ratio, rtol=1e-6, atol=0)
    assert float(metres.abs().max()) > 0


def test_relative_predictions_do_not_depend_on_size_and_stiffness(make_scene, scene, batch):
    """u/L is a function of f/(E L^2), up to the rounding errors of float32."""
    steel = make_scene(size=(1.0, 0.25, 0.25), young=2e11)
    module, twin = surrogate(scene).eval(), surrogate(steel).eval()
    force = 4500.0 * 100.0**2 * batch.force
    young = torch.full_like(batch.young, 4500.0)
    with torch.no_grad():
        soft = module(force, young) / 100.0
        stiff = twin(2e11 * 1.0**2 * batch.force, torch.full_like(young, 2e11)) / 1.0
    assert torch.allclose(soft, stiff, rtol=0, atol=1e-5 * float(soft.abs().max()))


def test_fixed_degrees_of_freedom_have_exactly_zero_displacement(scene, batch):
    module = surrogate(scene).eval()
    wild = Load(batch.force + 1.0, batch.young)  # forces where none can act, too
    with torch.no_grad():
        answer = module.predict(wild)
    assert torch.equal(answer[:, ~scene.problem.free], torch.zeros(12, 27, dtype=torch.float64))
    assert answer[:, scene.problem.free].abs().min() > 0


def test_the_network_has_single_and_predictions_have_double_precision(scene, batch):
    seen = []

    class Spy(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.ones(()))

        def forward(self, force, scalars):
            seen.append(force.dtype)
            return self.weight * force

    module = Surrogate(Spy(), MSE(), scene)
    assert module.predict(batch.load).dtype == torch.float64
    assert seen == [torch.float32]
    assert all(p.dtype == torch.float32 for p in module.parameters())


def test_scales_are_a_function_of_the_scene_and_make_fields_of_order_one(make_scene, scene, batch):
    both = [scales(one, *sampled_solutions(one)) for one in (scene, make_scene())]
    for ours, theirs in zip(*both, strict=True):
        assert torch.equal(ours, theirs)
        assert ours.shape == (), "a single number preserves the proportions of a field"
    force_scale, displacement_scale = both[0]
    reach, free = scene.loads.loadable_dofs, scene.problem.free
    force = (batch.force / force_scale)[:, reach]
    linear = torch.stack([scene.linear.solve(f) for f in batch.force]) / displacement_scale
    assert 0.3 < float(force.square().mean().sqrt()) < 3
    assert 0.3 < float(linear[:, free].square().mean().sqrt()) < 3


# ------------------------------------------------------------------ the schedule


def schedule(total, **options):
    optimizer = torch.optim.SGD([nn.Parameter(torch.zeros(1))], lr=1.0)
    scheduler = warmup_cosine(optimizer, total_steps=total, **options)
    rates = []
    for _ in range(total):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    return np.array(rates), optimizer.param_groups[0]["lr"]


def test_the_learning_rate_rises_then_falls_to_zero():
    rates, last = schedule(100, warmup=0.1)
    assert rates.max() == pytest.approx(1.0)
    assert rates.argmax() == 10
    for total in (1, 2, 5):
        few, _ = schedule(total)
        assert ((few > 0) & (few <= 1)).all()
    assert (np.diff(rates[:11]) > 0).all()
    assert (np.diff(rates[10:]) < 0).all()
    assert (rates > 0).all()
    assert last == pytest.approx(0.0, abs=1e-12)
    for warmup in (-0.1, 1.0):
        with pytest.raises(ValueError, match="warmup"):
            schedule(10, warmup=warmup)


# ------------------------------------------------------------------ training


def test_training_lowers_its_loss(scene, data, tmp_path):
    module, train = surrogate(scene, LrPlus(), lr=3e-3), data.samples("train")

    def value():
        with torch.no_grad():
            return float(module.loss(module.predict(train.load), train, module.physics))

    before = value()
    tutor = trainer(tmp_path, max_epochs=60, check_val_every_n_epoch=60)
    tutor.fit(module, datamodule=data)  # residuals rise at first, with rotations
    assert value() < 0.6 * before


def test_metrics_are_those_of_the_predictions_and_reset_after_each_epoch(scene, data, tmp_path):
    module = surrogate(scene, lr=0.0)  # nothing is learnt: every epoch has the same numbers
    seen = []

    class Watch(L.Callback):
        def on_validation_end(self, trainer, module):
            seen.append(float(trainer.callback_metrics["val/SNR_min"]))

    tutor = trainer(tmp_path, Watch(), max_epochs=3)
    tutor.fit(module, datamodule=data)
    assert len(seen) == 3
    assert len(set(seen)) == 1
    val = data.samples("val")
    with torch.no_grad():
        error = (module.predict(val.load) - val.displacement).flatten(1)
    expected = error.norm(dim=1).mean() / error.shape[1]
    assert float(tutor.callback_metrics["val/e_mean"]) == pytest.approx(float(expected), rel=1e-5)
    assert torch.load(tmp_path / "last.ckpt", weights_only=True)["epoch"] == 2, "not the best one"
    (numbers,) = trainer(tmp_path).test(module, datamodule=data, verbose=False)
    assert set(numbers) == {f"test/{name}" for name in METRICS}


# ------------------------------------------------------------------ resume


def run(scene, folder, data, *callbacks, epochs=4, stop=None, resume=None, loss=LrPlus):
    module = surrogate(scene, loss(), seed=0 if resume is None else 99)
    callbacks = [*callbacks, *([StopAfter(stop)] if stop else [])]
    tutor = trainer(folder, *callbacks, max_epochs=epochs)
    tutor.fit(module, datamodule=data, ckpt_path=resume, weights_only=True)
    return module, tutor


@pytest.mark.parametrize("averages", [False, True])
def test_a_resumed_run_ends_bit_for_bit_like_an_uninterrupted_one(
    scene, folder, data, tmp_path, averages
):
    """The weight of the residual changes from epoch to epoch."""

    def loss():
        return BlendedLoss(MSE(), LrPlus(), epochs=3)

    def fresh():
        options = {"train": 12, "val": 4, "test": 4, "batch_size": 4, "workers": 0}
        return DataModule(scene, folder=str(folder), **options)

    def fit(name, **options):
        average = [AveragedWeights(decay=0.8)] if averages else []
        return run(scene, tmp_path / name, fresh(), *average, loss=loss, **options)

    straight, whole = fit("straight")
    half, part = fit("parts", stop=2)
    assert (part.current_epoch, part.global_step) == (2, 6)
    resumed, end = fit("parts", resume="last")
    assert (end.current_epoch, end.global_step) == (4, 12)
    assert not identical(weights(half), weights(straight))
    assert identical(weights(resumed), weights(straight))
    numbers = [
        {name: float(value) for name, value in t.callback_metrics.items()} for t in (whole, end)
    ]
    assert numbers[0] == numbers[1]
    best = [t.checkpoint_callback.best_model_score for t in (whole, end)]
    assert best[0] == best[1]


def draws():
    """Returns numbers of every generator."""
    numbers = np.random.standard_normal(3).tolist()  # noqa: NPY002
    return [torch.rand(3).tolist(), numbers, [random.random(), random.gauss(0, 1)]]


@pytest.fixture
def generators():
    """Restores the random states after a test."""
    before = random_states()
    yield
    set_random_states(before)


def test_random_numbers_continue_from_stored_states_at_the_start_of_a_training(
    scene, generators, tmp_path
):
    """Loading for an evaluation does not change them; states of missing devices are ignored."""
    module, many = surrogate(scene), random_states() | {"cuda": [torch.zeros(16).byte()] * 2}
    torch.save({"random": many}, tmp_path / "states")
    first, second = draws(), draws()
    stored = torch.load(tmp_path / "states", weights_only=True)
    module.on_load_checkpoint({"scene": scene.fingerprint, **stored})
    assert draws() not in (first, second)
    module.on_train_start()
    assert [draws(), draws()] == [first, second]


def test_an_interrupted_stream_continues_with_new_loads(scene, folder, data, tmp_path):
    def stream():
        source = Stream(batches=3, new_per_round=4, reuse=1, capacity=16)
        options = {"val": 4, "test": 4, "workers": 0, "batch_size": 4}
        return DataModule(scene, folder=str(folder), train=source, **options)

    _, part = run(scene, tmp_path, stream(), stop=1)
    assert part.datamodule.state_dict() == {"next_index": 12}
    _, end = run(scene, tmp_path, stream(), epochs=2, resume="last")
    assert end.datamodule.state_dict() == {"next_index": 24}


# ------------------------------------------------------------------ checkpoints


def test_best_weights_have_the_smallest_error_and_checkpoints_the_scales(scene, data, tmp_path):
    seen = []

    class Watch(L.Callback):
        def on_validation_end(self, trainer, module):
            seen.append(float(trainer.callback_metrics["val/e_mean"]))

    tutor = trainer(tmp_path, Watch(), max_epochs=4)
    module = surrogate(scene, lr=3e-2)
    tutor.fit(module, datamodule=data)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["best.safetensors", "last.ckpt"]
    assert read(tmp_path / "best.safetensors")["epoch"] == int(np.argmin(seen))
    checkpoint = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert checkpoint["scene"] == scene.fingerprint
    state = checkpoint["state_dict"]
    expected = float((scene.loads.eigenmodes.vectors @ scene.loads.q_max).norm())
    assert module.physics.largest_force == pytest.approx(expected, rel=1e-12)
    force_scale, displacement_scale = scales(scene, *sampled_solutions(scene))
    assert torch.equal(state["predictor.force_scale"], force_scale)
    assert torch.equal(state["predictor.displacement_scale"], displacement_scale)


def test_the_checkpoint_of_another_scene_raises_an_error_with_both_fingerprints(scene, make_scene):
    other, checkpoint = make_scene(poisson=0.25), {"state_dict": {}}
    surrogate(scene).on_save_checkpoint(checkpoint)
    with pytest.raises(ValueError, match="scene") as refusal:
        surrogate(other).on_load_checkpoint(checkpoint)
    assert scene.fingerprint[:12] in str(refusal.value)
    assert other.fingerprint[:12] in str(refusal.value)
    surrogate(scene).on_load_checkpoint(checkpoint)
    with pytest.raises(ValueError, match="unknown"):
        surrogate(scene).on_load_checkpoint({"state_dict": {}})


def test_skipped_work_is_that_of_network_and_loss(scene):
    module = surrogate(scene, MSE())
    assert module.skipped_work() == [*module.net.skipped_work(), *module.loss.saves]
    assert Surrogate(nn.Identity(), LrPlus(), scene).skipped_work() == []
    fitted = nn.Identity()
    fitted.fit = None
    assert Surrogate(fitted, MSE(), scene).skipped_work() == [], "it has no loss"

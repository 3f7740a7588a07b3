"""Steps with non-finite gradients are skipped, counted and stop a training that diverged."""

import lightning as L
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader

from dpl.training import Diverged, Muon, SkipNonFiniteGradients


class Line(L.LightningModule):
    """Learns y = 3 x; the loss, or only its gradient, of a non-finite batch is not finite."""

    def __init__(self, optimizer, kind="loss"):
        super().__init__()
        self.net, self.make, self.kind = nn.Linear(1, 1), optimizer, kind

    def training_step(self, x, _):
        finite = torch.nan_to_num(x)
        loss = (self.net(finite) - 3 * finite).square().mean()
        if self.kind == "loss":
            return loss * (1 + 0 * x.sum())
        if x.isnan().any():  # a finite loss, a slope that is not: the root at zero
            return loss + (self.net.weight - self.net.weight.detach()).abs().sqrt().sum()
        return loss

    def configure_optimizers(self):
        return self.make(self.parameters())


OPTIMIZERS = {
    "adam": lambda parameters: torch.optim.AdamW(parameters, lr=0.05, fused=True),
    "muon": lambda parameters: Muon(parameters, lr=0.05),
    "sgd": lambda parameters: torch.optim.SGD(parameters, lr=0.1, momentum=0.5),
}


def fit(tmp_path, batches, *, optimizer="adam", kind="loss", epochs=1, guard=None, ckpt_path=None):
    torch.manual_seed(0)
    module, guard = Line(OPTIMIZERS[optimizer], kind), guard or SkipNonFiniteGradients(patience=3)
    trainer = L.Trainer(
        max_epochs=epochs, logger=False, enable_progress_bar=False, enable_model_summary=False,
        callbacks=[guard], default_root_dir=tmp_path, accelerator="cpu", log_every_n_steps=1,
        enable_checkpointing=False,
    )  # fmt: skip
    trainer.fit(module, DataLoader(batches, batch_size=None), ckpt_path=ckpt_path)
    return module, guard, trainer


GOOD = [torch.tensor([[x], [-x]]) for x in torch.linspace(0.5, 1.5, 40).tolist()]
BAD = torch.tensor([[1.0], [torch.nan]])


@pytest.mark.parametrize(
    ("optimizer", "kind"), [("adam", "loss"), ("muon", "slope"), ("sgd", "slope")]
)
def test_a_step_with_nonfinite_gradients_changes_nothing_and_is_counted(
    tmp_path, capsys, optimizer, kind
):
    clean, none, _ = fit(tmp_path, GOOD, optimizer=optimizer, kind=kind)
    poisoned = [*GOOD[:10], BAD, *GOOD[10:20], BAD, BAD, *GOOD[20:]]
    module, guard, trainer = fit(tmp_path, poisoned, optimizer=optimizer, kind=kind)
    assert (none.skipped_steps, guard.skipped_steps) == (0, 3)
    assert float(trainer.callback_metrics["skipped_steps"]) == 3
    assert all(map(torch.equal, module.parameters(), clean.parameters()))
    reported = capsys.readouterr().err
    assert "epoch 0, step 10: gradients are not finite; the step is skipped" in reported
    assert "3 steps were skipped" in reported


def test_a_training_without_finite_gradients_raises_diverged(tmp_path):
    with pytest.raises(Diverged, match=r"3 consecutive steps .*rate of 5.0e-02; reduce opt"):
        fit(tmp_path, [*GOOD[:5], *[BAD] * 9])


def test_skipped_steps_that_are_not_consecutive_do_not_stop_the_training(tmp_path):
    _, guard, _ = fit(tmp_path, [part for good in GOOD for part in (BAD, BAD, good)])
    assert guard.skipped_steps == 80


def test_a_resumed_run_continues_the_count():
    guard, other = SkipNonFiniteGradients(), SkipNonFiniteGradients()
    guard.skipped_steps = 7
    other.load_state_dict(guard.state_dict())
    assert other.skipped_steps == 7


@pytest.mark.parametrize("patience", [0, -1])
def test_a_patience_out_of_range_raises_an_error(patience):
    with pytest.raises(ValueError, match=f"patience = {patience} must be 1 or more"):
        SkipNonFiniteGradients(patience=patience)


@pytest.mark.parametrize(("error", "said"), [(1.7, True), (torch.nan, True), (0.4, False)])
def test_a_median_error_above_one_prints_a_warning(tmp_path, capsys, error, said):
    _, guard, trainer = fit(tmp_path, GOOD)
    trainer.callback_metrics["val/rel_L2_median"] = torch.tensor(error)
    capsys.readouterr()
    guard.on_train_end(trainer, trainer.lightning_module)
    assert ("no better than a prediction of zero" in capsys.readouterr().err) == said


def test_a_learning_rate_far_too_high_ends_with_one_line(script, tiny_training, tmp_path):
    wild = ["optimizer.lr=1e6", "logger=none", "trainer.max_epochs=30", "run=runs/wild"]
    ended = script("train", *tiny_training, *wild, cwd=tmp_path)
    assert ended.status == 2
    last = ended.err.strip().splitlines()[-1]
    assert last.startswith("error: training has diverged: the gradients of 20 consecutive steps")
    assert "reduce optimizer.lr" in last
    assert "Traceback" not in ended.err


def test_a_training_with_nonfinite_predictions_fails(script, tiny_training, tmp_path):
    """The run is shorter than `patience`, and every validation gives NaN."""
    wild = ["optimizer.lr=1e6", "logger=none", "trainer.max_epochs=3", "run=wild"]
    ended = script("train", *tiny_training, *wild, cwd=tmp_path)
    assert ended.status == 2
    last = ended.err.strip().splitlines()[-1]
    assert last.startswith("error: training has diverged: ")
    assert "the answers of the network are not finite; lower optimizer.lr" in last
    assert "Traceback" not in ended.err
    left = [path.name for path in (tmp_path / "wild/checkpoints").iterdir()]
    assert left == ["last.ckpt"], "nothing is called best"

"""Laws of learning curves."""

from torch.utils.tensorboard import SummaryWriter

from benchmarks import learning_curves
from benchmarks.learning_curves import ERROR, Validation


def write_events(folder, errors, steps=10):
    """Log an error after each epoch of `steps` steps, and the epoch at every fifth step."""
    with SummaryWriter(folder) as log:
        for epoch, error in errors.items():
            for step in range(epoch * steps, (epoch + 1) * steps, 5):
                log.add_scalar("epoch", epoch, step + 4)
            log.add_scalar(ERROR, error, (epoch + 1) * steps - 1)


def test_a_curve_counts_trained_epochs(tmp_path):
    run = tmp_path / "cnn"
    write_events(run, {0: 0.5, 3: 0.25})
    assert learning_curves.curve(run) == [Validation("cnn", 1, 0.5), Validation("cnn", 4, 0.25)]


def test_a_resumed_run_has_one_curve(tmp_path):
    run = tmp_path / "cnn"
    write_events(run, {0: 0.5, 1: 0.25})
    write_events(run, {2: 0.125})
    assert [point.epoch for point in learning_curves.curve(run)] == [1, 2, 3]


def test_a_run_with_fewer_than_two_validations_has_no_curve(tmp_path):
    write_events(tmp_path / "once", {0: 0.5})
    (tmp_path / "unrolled").mkdir()
    assert learning_curves.curve(tmp_path / "unrolled") == []
    runs = [tmp_path / "once", tmp_path / "unrolled"]
    assert not learning_curves.save(runs, tmp_path / "curves")
    assert not list(tmp_path.glob("curves*"))

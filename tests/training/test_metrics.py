"""Metrics against the formulas of the paper in NumPy."""

import numpy as np
import pytest
import torch

from dpl import Sample
from dpl.fem import Problem
from dpl.training import MaxError, MeanError, MinSNR, MinVolumeRatio, RelativeL2, ResidualRatio
from dpl.training.metrics import PerLoadErrors, default_metrics, median


@pytest.fixture(scope="module")
def prediction(scene, batch):
    random = torch.Generator().manual_seed(0)
    noise = torch.randn(batch.force.shape, generator=random, dtype=torch.float64)
    return batch.displacement + torch.where(scene.problem.free, 1e-3 * noise, 0.0)


def by_hand(problem: Problem, prediction, batch):
    """Return every metric, computed load by load without `dpl.training.metrics`."""
    u, v, f = (x.numpy() for x in (prediction, batch.displacement, batch.force))
    loads, nodes, dim = u.shape
    whole = [np.linalg.norm(u[s] - v[s]) for s in range(loads)]
    ratio = [np.linalg.norm(u[s]) / whole[s] for s in range(loads)]
    relative = sorted(whole[s] / np.linalg.norm(v[s]) for s in range(loads))
    internal = problem.internal_force(prediction).numpy()
    free = problem.free.numpy()
    residual = sorted(
        np.linalg.norm((internal[s] - f[s])[free]) / np.linalg.norm(f[s]) for s in range(loads)
    )
    F = problem.discretisation.gradient(prediction).numpy() + np.eye(3)
    return {
        "e_mean": sum(whole) / (nodes * dim * loads),
        "e_max": max(np.linalg.norm(u[s, i] - v[s, i]) for s in range(loads) for i in range(nodes)),
        "SNR_min": 20 * np.log10(min(ratio)),
        "SNR_min_printed": 10 * np.log10(min(ratio)),
        "rel_L2_median": np.median(relative),
        "rel_L2_worst": relative[-1],
        "residual": np.median(residual),
        "min_det_F": np.linalg.det(F).min(),
    }


def test_metrics_are_the_formulas(scene, prediction, batch):
    found = default_metrics(scene.problem)
    found.update(prediction, batch)
    expected = by_hand(scene.problem, prediction, batch)
    numbers = {name: float(value) for name, value in found.compute().items()}
    assert numbers == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9])
def test_the_median_equals_that_of_numpy(count):
    values = np.random.default_rng(count).normal(size=(count, 3))
    assert median(torch.from_numpy(values)).numpy() == pytest.approx(np.median(values, axis=0))
    assert float(median(torch.from_numpy(values[:, 0]))) == pytest.approx(np.median(values[:, 0]))


def test_the_median_of_infinite_values_is_infinite_and_of_nan_is_nan():
    inf, nan = torch.inf, torch.nan
    assert float(median(torch.tensor([1.0, inf, inf, inf]))) == inf
    assert float(median(torch.tensor([1.0, 2.0, 3.0, inf]))) == 2.5
    assert median(torch.tensor([1.0, nan, 3.0])).isnan()


def test_batches_accumulate_in_the_forward_method(scene, prediction, batch):
    """A collection that is called returns the metrics of the batch and accumulates them."""
    found, whole = default_metrics(scene.problem), default_metrics(scene.problem)
    whole.update(prediction, batch)
    for start, end in ((0, 5), (5, 6), (6, 12)):
        rows = prediction[start:end], Sample(*(column[start:end] for column in batch))
        one = default_metrics(scene.problem)
        one.update(*rows)
        assert found(*rows) == one.compute()
    assert {k: float(v) for k, v in found.compute().items()} == pytest.approx(
        {k: float(v) for k, v in whole.compute().items()}, rel=1e-12
    )


def test_the_body_is_evaluated_once_per_batch(scene, prediction, batch, monkeypatch):
    calls, evaluate = [], Problem.evaluate
    monkeypatch.setattr(
        Problem, "evaluate", lambda *arguments: calls.append(1) or evaluate(*arguments)
    )
    monkeypatch.setattr(Problem, "volume_ratio", None)
    found = default_metrics(scene.problem).clone(prefix="val/")
    for count in (1, 2, 3):
        found.update(prediction, batch)
        assert len(calls) == count
    found.compute()
    assert len(calls) == 3


def test_errors_of_single_precision_predictions_are_computed_in_double_precision(
    scene, prediction, batch
):
    found = default_metrics(scene.problem)
    found.update(prediction.float(), batch)
    assert all(value.dtype == torch.float64 for value in found.compute().values())


def test_noise_of_a_tenth_of_the_signal_is_20_dB_and_printed_as_10(batch):
    """10 log10 of power is 20 log10 of amplitude; the tables of the paper are in power dB."""
    scaled = batch.displacement * 1.0
    error = scaled.flip(0)
    error *= (scaled.flatten(1).norm(dim=1) / error.flatten(1).norm(dim=1))[:, None, None] / 10
    shifted = Sample(batch.force, scaled - error, batch.young)
    for printed, decibels in ((False, 20.0), (True, 10.0)):
        snr = MinSNR(printed=printed)
        snr.update(scaled, shifted)
        assert float(snr.compute()) == pytest.approx(decibels, abs=1e-9)


def test_the_reference_solution_has_zero_residual_and_infinite_snr(scene, batch):
    found = default_metrics(scene.problem)
    found.update(batch.displacement, batch)
    numbers = found.compute()
    assert float(numbers["e_mean"]) == float(numbers["e_max"]) == 0.0
    assert float(numbers["SNR_min"]) == torch.inf
    assert float(numbers["residual"]) < scene.solver.tol
    assert float(numbers["min_det_F"]) > 0


def test_an_inverted_prediction_has_a_negative_min_det_F(scene, batch):
    problem = scene.problem
    points = torch.where(problem.free, -1.5 * problem.points, 0.0).expand_as(batch.force)
    volume = MinVolumeRatio(problem)
    volume.update(points, batch)
    assert float(volume.compute()) < 0
    residual = ResidualRatio(problem)
    residual.update(points, batch)
    assert float(residual.compute()) > 1  # infinite, and not NaN


def test_the_metrics_of_a_nan_prediction_are_never_the_best(scene, batch):
    broken = torch.full_like(batch.displacement, torch.nan)
    found = default_metrics(scene.problem)
    found.update(broken, batch)
    numbers = {name: float(value) for name, value in found.compute().items()}
    assert numbers["residual"] == torch.inf
    assert numbers["min_det_F"] == -torch.inf
    for name in ("e_mean", "e_max", "rel_L2_worst"):
        assert not numbers[name] < 1e9


METRICS = [MeanError, MaxError, MinSNR, RelativeL2, ResidualRatio, MinVolumeRatio]


@pytest.mark.parametrize("kind", METRICS[:5])
def test_a_metric_of_a_load_does_not_depend_on_its_batch(scene, prediction, batch, kind):
    """The volume ratio is that of the whole batch, in `Problem.volume_ratio`."""
    metric = kind(scene.problem) if kind is ResidualRatio else kind()
    whole = metric.measure(prediction, batch)
    assert whole.shape == (len(prediction),)
    for k in range(len(prediction)):
        one = metric.measure(
            prediction[k : k + 1], Sample(*(column[k : k + 1] for column in batch))
        )
        assert float(one) == pytest.approx(float(whole[k]), rel=1e-12)


def test_metrics_of_several_processes_cover_all_loads(prediction, batch):
    """Concatenates the states like torchmetrics in two processes, without processes."""
    parts = [MeanError(), MeanError()]
    for part, rows in zip(parts, (slice(0, 5), slice(5, 12)), strict=True):
        part.update(prediction[rows], Sample(*(column[rows] for column in batch)))
    parts[0].merge_state(parts[1])
    whole = MeanError()
    whole.update(prediction, batch)
    assert float(parts[0].compute()) == pytest.approx(float(whole.compute()), rel=1e-12)


def test_metrics_that_agree_on_the_first_batch_are_computed_separately(scene, prediction, batch):
    """At the reference solution e_mean and e_max are both zero and have equal states."""
    found = default_metrics(scene.problem)
    found.update(batch.displacement, batch)
    found.update(prediction, batch)
    expected = by_hand(scene.problem, prediction, batch)
    numbers = {name: float(value) for name, value in found.compute().items()}
    for name in ("e_max", "SNR_min", "SNR_min_printed", "rel_L2_worst"):
        assert numbers[name] == pytest.approx(expected[name], rel=1e-9), name
    assert numbers["e_mean"] == pytest.approx(expected["e_mean"] / 2, rel=1e-9)


# ------------------------------------------------------------------ which loads are shown


def test_the_title_of_a_load_contains_its_size_its_errors_and_their_ranks():
    relative = torch.tensor([0.012345, 0.04, 0.03, 0.02])
    largest = torch.tensor([0.4, 0.1, 0.2, 0.3])
    judged = PerLoadErrors(relative, largest, torch.tensor([0.2567, 0.1, 0.1, 0.1]))
    assert judged.title(0) == (
        "load 0, max displacement 0.26 L\nrelative L2 1.23 %: rank 4 of 4\nmax error 0.4 L: largest"
    )
    ranks = [[line.split(": ")[1] for line in judged.title(k).split("\n")[1:]] for k in (1, 2, 3)]
    assert ranks == [
        ["largest", "rank 4 of 4"],
        ["2nd largest", "3rd largest"],
        ["3rd largest", "2nd largest"],
    ]


def test_largest_absolute_is_the_load_with_the_largest_absolute_error():
    relative, largest = torch.tensor([0.9, 0.1, 0.2]), torch.tensor([0.1, 0.8, 0.7])
    assert PerLoadErrors(relative, largest, largest).largest_absolute == 1
    assert (
        PerLoadErrors(relative, torch.tensor([0.1, 0.8, torch.nan]), largest).largest_absolute == 2
    )


def test_equal_errors_are_in_the_order_of_the_loads():
    """There are enough loads for an unstable sort to permute them."""
    same = torch.full((1000,), 0.5)
    assert PerLoadErrors(same, same, same).select(3) == [*range(6), 503]


def test_few_loads_are_all_selected_once():
    one = torch.tensor([0.5])
    assert PerLoadErrors(one, one, one).select(2) == [0]
    two = torch.tensor([0.5, 0.7])
    assert PerLoadErrors(two, two, two).select(1) == [1, 0]

"""Metrics against the formulas of the paper in NumPy, and the loads that are drawn."""

import numpy as np
import pytest
import torch

from dpl import Sample
from dpl.fem import Problem
from dpl.training import ErrorMetrics
from dpl.training.metrics import PerLoadErrors, errors_of, median


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


def some(batch, rows):
    return Sample(*(column[rows] for column in batch))


def test_metrics_of_a_batch_or_of_its_parts_are_the_formulas(scene, prediction, batch):
    """Also those of several processes, whose states are merged."""
    expected = by_hand(scene.problem, prediction, batch)
    assert errors_of(scene.problem, prediction, batch) == pytest.approx(expected, rel=1e-9)
    parts, whole = [], ErrorMetrics(scene.problem)
    for rows in (slice(0, 5), slice(5, 6), slice(6, 12)):
        one, part = ErrorMetrics(scene.problem), ErrorMetrics(scene.problem)
        for metrics in (one, part):
            metrics.update(prediction[rows], some(batch, rows))
        parts.append(part)
        assert whole(prediction[rows], some(batch, rows)) == one.compute()
    parts[0].merge_state(parts[1])
    parts[0].merge_state(parts[2])
    for metrics in (whole, parts[0]):
        found = {name: float(value) for name, value in metrics.compute().items()}
        assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9])
def test_the_median_equals_that_of_numpy(count):
    values = np.random.default_rng(count).normal(size=(count, 3))
    assert median(torch.from_numpy(values)).numpy() == pytest.approx(np.median(values, axis=0))
    inf, nan = torch.inf, torch.nan
    assert float(median(torch.tensor([1.0, inf, inf, inf]))) == inf
    assert float(median(torch.tensor([1.0, 2.0, 3.0, inf]))) == 2.5
    assert median(torch.tensor([1.0, nan, 3.0])).isnan()


def test_metrics_are_computed_in_double_precision(scene, prediction, batch):
    found = ErrorMetrics(scene.problem)
    found.update(prediction.float(), batch)
    assert all(value.dtype == torch.float64 for value in found.compute().values())


def test_noise_of_a_tenth_of_the_signal_is_20_dB_and_printed_as_10(scene, batch):
    """10 log10 of power is 20 log10 of amplitude; the tables of the paper are in power dB."""
    scaled = batch.displacement * 1.0
    error = scaled.flip(0)
    error *= (scaled.flatten(1).norm(dim=1) / error.flatten(1).norm(dim=1))[:, None, None] / 10
    found = errors_of(scene.problem, scaled, batch._replace(displacement=scaled - error))
    assert found["SNR_min"] == pytest.approx(20.0, abs=1e-9)
    assert found["SNR_min_printed"] == pytest.approx(10.0, abs=1e-9)


def test_metrics_of_the_reference_solution_of_inverted_elements_and_of_nan(scene, batch):
    """A NaN prediction is never the best one; no metric of an inverted one is NaN."""
    found = errors_of(scene.problem, batch.displacement, batch)
    assert found["e_mean"] == found["e_max"] == 0.0
    assert found["SNR_min"] == torch.inf
    assert found["residual"] < scene.solver.tol
    assert found["min_det_F"] > 0
    problem = scene.problem
    points = torch.where(problem.free, -1.5 * problem.points, 0.0).expand_as(batch.force)
    found = errors_of(scene.problem, points, batch)
    assert found["min_det_F"] < 0
    assert found["residual"] > 1  # infinite, and not NaN
    found = errors_of(scene.problem, torch.full_like(batch.displacement, torch.nan), batch)
    assert found["residual"] == torch.inf
    assert found["min_det_F"] == -torch.inf
    for name in ("e_mean", "e_max", "rel_L2_worst"):
        assert not found[name] < 1e9


# ------------------------------------------------------------------ which loads are shown


def test_loads_with_the_largest_errors_of_both_kinds_and_a_typical_load_are_selected():
    relative = torch.tensor([0.1, 0.5, 0.2, 0.9, 0.3, 0.4, 0.15])
    largest = torch.tensor([0.7, 0.1, 0.8, 0.3, 0.9, 0.0, 0.05])
    judged = PerLoadErrors(relative, largest, torch.full((7,), 0.25))
    assert judged.select(1) == [3, 4, 2], "2 is the third of the five that are left"
    assert judged.select(2) == [3, 1, 4, 2, 6], "neither twice"
    worst = torch.tensor([0.1, 0.9, 0.2, 0.3, 0.05])
    judged = PerLoadErrors(worst, worst, worst)
    assert judged.select(1) == [1, 3, 0], "a load with both largest errors is selected once"
    assert judged.select(3) == [1, 3, 2, 0, 4]
    one, two = torch.tensor([0.5]), torch.tensor([0.5, 0.7])
    assert PerLoadErrors(one, one, one).select(2) == [0]
    assert PerLoadErrors(two, two, two).select(1) == [1, 0]
    same = torch.full((1000,), 0.5)  # enough loads for an unstable sort to permute them
    assert PerLoadErrors(same, same, same).select(3) == [*range(6), 503]


def test_a_nan_prediction_has_the_largest_error():
    errors = torch.tensor([0.1, torch.inf, torch.nan, 0.3])
    judged = PerLoadErrors(errors, torch.tensor([0.1, 0.8, torch.nan, 0.0]), torch.ones(4))
    assert set(judged.select(1)[:2]) == {1, 2}


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

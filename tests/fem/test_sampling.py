"""Laws of random numbers: functions of their place, and distributed as they claim."""

import warnings
from functools import partial

import numpy as np
import pytest
from scipy import stats
from scipy.spatial import cKDTree
from scipy.stats import qmc

from dpl.fem.loads import (
    constant,
    log_tail_mixture,
    logarithmic,
    normal,
    symmetric_uniform,
    uniform01,
)
from dpl.fem.loads.sampling import SAMPLINGS, independent, sobol

GRID = (np.arange(10_000) + 0.5) / 10_000  # of the unit interval
LAST = 1 - 2.0**-53  # the largest number below 1


@pytest.fixture(params=SAMPLINGS)
def drawn(request):
    """Each way to fill the unit cube: seed, index, count -> (count,)."""
    return SAMPLINGS[request.param]


def stream(draw, seed, size, count=3):
    """Return the first points of a stream, (size, count)."""
    return np.stack([draw(seed, index, count) for index in range(size)])


# ---- distributions


def mixed(x, part=0.25, low=1e-3):
    """Return the part of the draws of `log_tail_mixture` that lie below x < 1."""
    return part * stats.loguniform(low, 1).cdf(x)


LONG = {"part": 0.6, "low": 1e-5}
LAWS = {  # quantiles, cumulative distribution, smallest, largest
    "uniform": (symmetric_uniform, stats.uniform(-1, 2).cdf, -1, 1),
    "normal": (normal, stats.norm(0, 1 / 3).cdf, -1, 1),
    "even": (uniform01, stats.uniform(0, 1).cdf, 0, 1),
    "logarithmic": (logarithmic, stats.loguniform(1e-2, 1).cdf, 1e-2, 1),
    "four decades": (partial(logarithmic, low=1e-4), stats.loguniform(1e-4, 1).cdf, 1e-4, 1),
    "tail": (log_tail_mixture, mixed, 1e-3, 1),
    "long tail": (partial(log_tail_mixture, **LONG), partial(mixed, **LONG), 1e-5, 1),
}


@pytest.mark.parametrize("name", LAWS)
def test_quantiles_invert_the_distribution_that_is_claimed(name):
    quantile, cumulative, low, high = LAWS[name]
    values = quantile(GRID)
    inside = (values > low) & (values < high)  # elsewhere many draws share one value
    assert inside.sum() > 0.2 * len(GRID)
    assert cumulative(values[inside]) == pytest.approx(GRID[inside], abs=1e-12)


@pytest.mark.parametrize("name", LAWS)
def test_quantiles_rise_and_stay_in_range(name):
    quantile, _, low, high = LAWS[name]
    values = quantile(np.array([0.0, 1e-300, *GRID, LAST]))
    assert (np.diff(values) >= 0).all()
    assert values[0] == low
    assert values[-1] == pytest.approx(high, rel=1e-15)
    assert values[-1] <= high


@pytest.mark.parametrize("name", [*LAWS, "one"])
@pytest.mark.parametrize("shape", [(), (0,), (3, 4)])
def test_quantiles_keep_the_shape(name, shape):
    quantile = LAWS[name][0] if name in LAWS else constant
    t = np.full(shape, 0.3)
    assert np.shape(quantile(t)) == shape
    assert np.array_equal(t, np.full(shape, 0.3))


def test_a_small_part_with_a_long_tail_is_no_overflow():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (log_tail_mixture(GRID, 1e-3, 1e-3) <= 1).all()


@pytest.mark.parametrize(
    ("quantile", "name"),
    [(logarithmic, "low"), (log_tail_mixture, "low"), (log_tail_mixture, "part")],
)
@pytest.mark.parametrize("value", [0.0, 1.0, -0.1, 2.0, float("nan")])
def test_parameters_out_of_range_are_refused_by_name(quantile, name, value):
    with pytest.raises(ValueError, match=f"{name} = {value} must lie between 0 and 1"):
        quantile(GRID, **{name: value})


# ---- points


def test_points_are_functions_of_seed_and_index(drawn):
    """In any order, among other streams."""
    points = stream(drawn, (3, 1), 40)
    for index in (39, 0, 7, 7, 23, 0):
        for other in range(10):
            drawn((other, 0), index + other, 3)
        drawn((3, 1), index + 1, 4)
        assert np.array_equal(drawn((3, 1), index, 3), points[index])


def test_seeds_and_indices_give_different_points(drawn):
    seeds = [(0, 0), (0, 1), (1, 0), (0, 2), (1, 1), (2, 0)]
    streams = [stream(drawn, seed, 16) for seed in seeds]
    points = np.concatenate(streams)
    assert len(np.unique(points, axis=0)) == len(points)
    assert len(np.unique(points)) == points.size  # no coordinate is that of another


def test_points_of_one_stream_are_no_nearer_to_those_of_another_than_by_chance(drawn):
    """Validation asks for nothing that training has seen."""
    ours, theirs, chance = (
        stream(draw, (0, name), 256) for draw, name in ((drawn, 0), (drawn, 1), (independent, 2))
    )
    near, usual = (cKDTree(ours).query(points)[0] for points in (theirs, chance))
    assert near.mean() > 0.8 * usual.mean()
    assert near.min() > 0.2 * usual.min()


def test_no_point_is_drawn_with_a_warning(drawn):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for index in (*range(64), 1000, 12_345, 2**20 + 1):
            point = drawn((0, 0), index, 9)
            assert point.dtype == np.float64
            assert ((point > 0) & (point < 1)).all()


def test_random_access_to_a_sobol_sequence_equals_its_order():
    engine = qmc.Sobol(5, scramble=True, rng=np.random.default_rng([7, 2]))
    assert np.array_equal(stream(sobol, (7, 2), 64, 5), engine.random(64))

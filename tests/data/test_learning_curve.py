"""Laws of learning curves: the power law through the last points, and its words."""

import math

import pytest

from dpl.data.sources import CurvePoint, describe, loads_for


def curve(*pairs):
    return [CurvePoint(loads, 2.0, error, 10 * error, 1e-3 * error) for loads, error in pairs]


def test_a_power_law_is_continued_exactly():
    points = curve(*((n, 3.0 * n**-1.5) for n in (64, 128, 256)))
    assert loads_for(points, 3.0 * 1000**-1.5) in (1000, 1001)


def test_only_the_last_points_count():
    early = curve((2, 1e-9), (4, 1e9))
    last = curve(*((n, n**-1.0) for n in (64, 128, 256, 512)))
    assert loads_for(early + last, 1e-3) == loads_for(last, 1e-3)


@pytest.mark.parametrize(
    "points",
    [
        curve(),
        curve((64, 1e-2)),
        curve((64, 1e-2), (64, 1e-3)),
        curve((64, 1e-3), (128, 1e-2)),
        curve((64, 1e-2), (128, 1e-2)),
        curve((64, math.nan), (128, 1e-2)),
        curve((64, 0.011), (128, 0.01)),
    ],
)
def test_without_a_decrease_nothing_is_predicted(points):
    assert loads_for(points, 1e-9) is None


def test_a_point_is_described_with_its_prediction():
    points = curve((256, 1e-3), (512, 5e-4))
    assert describe(points, 4e-4) == (
        "512 loads, 2 s: median 0.05 %, worst 0.5 %, e_mean 5.0e-07; about 640 loads for 0.04 %"
    )
    assert describe(points, 1e-3).endswith("; target of 0.1 % reached")
    assert describe(points[:1], 1e-4).endswith("e_mean 1.0e-06")

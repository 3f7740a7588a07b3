"""Engineering notation of the readings."""

import math

import pytest

from dpl.viewer.units import engineering, round_step, tick_labels, unit_for


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.0, "N", "0 N"),
        (9583.0, "N", "9.58 kN"),
        (0.0034, "m", "3.4 mm"),
        (24.2, "m", "24.2 m"),
        (999.6, "Pa", "1 kPa"),
        (123_456.0, "Pa", "123 kPa"),
        (2.03e11, "Pa", "203 GPa"),
        (-1250.0, "N/m", "-1.25 kN/m"),
        (5e-6, "m", "5 µm"),
        (math.nan, "N", "nan N"),
    ],
)
def test_values_have_three_digits_and_a_prefix(value, unit, text):
    assert engineering(value, unit) == text


def test_the_prefix_is_a_power_of_a_thousand():
    for exponent in range(-12, 15):
        name, factor = unit_for(2.0 * 10.0**exponent, "Pa")
        assert 1 <= 2.0 * 10.0**exponent / factor < 1000
        assert name.endswith("Pa")


@pytest.mark.parametrize(
    ("top", "name", "ticks"),
    [
        (1200.0, "kPa", ["0", "0.3", "0.6", "0.9", "1.2"]),
        (1000.0, "Pa", ["0", "250", "500", "750", "1000"]),
        (400.0, "Pa", ["0", "100", "200", "300", "400"]),
        (5e7, "MPa", ["0", "12.5", "25", "37.5", "50"]),
    ],
)
def test_numbers_of_a_scale_share_its_unit(top, name, ticks):
    unit, _, labels = tick_labels(top, "Pa")
    assert (unit, labels) == (name, ticks)


@pytest.mark.parametrize("span", [(1125.0, 18000.0), (0.25, 4.0), (1.0, 203.0), (1.0, 1.001)])
def test_values_of_a_slider_have_at_most_five_digits(span):
    step = round_step(*span)
    assert step == pytest.approx(10.0 ** round(math.log10(step)))
    digits = f"{round(span[1] / step):d}"
    assert len(digits) <= 5

"""Laws of acceptance statistics: each load is in one bin, and a biased set gives a warning."""

import numpy as np
import pytest

from dpl.data.storage.store import (
    BINS,
    AmplitudeBin,
    acceptance_table,
    amplitude_bins,
    bias_warning,
)


def test_every_load_lies_in_the_bin_whose_limits_enclose_its_amplitude():
    rng = np.random.default_rng(0)
    amplitudes = rng.random(500) ** 2
    accepted = rng.random(500) < 0.7
    parts = amplitude_bins(amplitudes.tolist(), accepted.tolist())
    assert sum(part.tried for part in parts) == 500
    assert sum(part.accepted for part in parts) == accepted.sum()
    assert len(parts) == BINS
    for k, part in enumerate(parts):
        last = k == BINS - 1
        inside = (amplitudes >= part.low) & ((amplitudes < part.high) | last)
        assert part.tried == inside.sum()
        assert part.accepted == (inside & accepted).sum()
    assert parts[0].low == 0
    assert parts[-1].high == pytest.approx(amplitudes.max())


def test_no_loads_make_no_bins_and_zero_loads_make_one():
    assert amplitude_bins([], []) == []
    (only,) = amplitude_bins([0.0, 0.0], [True, False])
    assert (only.tried, only.accepted) == (2, 1)


@pytest.mark.parametrize(
    ("tried", "accepted", "biased"),
    [
        (10, 8, True),
        (10, 9, False),
        (100, 89, True),
        (100, 90, False),
        (9, 0, False),
        (0, 0, False),
    ],
)
def test_a_bin_is_biased_if_less_than_nine_tenths_of_at_least_ten_loads_are_accepted(
    tried, accepted, biased
):
    assert AmplitudeBin(0.0, 1.0, tried, accepted).biased == biased


def test_the_warning_names_the_bin_with_the_lowest_acceptance_and_a_remedy():
    few = AmplitudeBin(1.0, 1.5, 9, 0)
    assert bias_warning([]) == bias_warning([AmplitudeBin(0.0, 0.5, 100, 95), few]) == ""
    parts = [AmplitudeBin(0.0, 0.5, 100, 85), AmplitudeBin(0.5, 1.0, 40, 10), few]
    reported = bias_warning(parts)
    assert "only 10 of 40 loads with amplitudes 0.50 to 1.00 were accepted" in reported
    assert "loads.deflection" in reported
    assert "\n" not in reported


def test_the_table_has_one_column_per_bin():
    assert acceptance_table([]) == []
    parts = [AmplitudeBin(0.0, 0.5, 1000, 850), AmplitudeBin(0.5, 1.0, 4, 1)]
    heads, cells = acceptance_table(parts)
    assert heads.split() == ["amplitude", "up", "to", "0.50", "1.00"]
    assert cells.split() == ["accepted", "850/1000", "1/4"]
    assert len(heads) == len(cells), "columns stand below each other"

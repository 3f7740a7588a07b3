"""Laws of the comparison on a single load."""

import pytest
import torch
from PIL import Image

from benchmarks import single_loads
from benchmarks.paper_tables import PAPER
from dpl import Sample
from dpl.training import ErrorMetrics


@pytest.fixture(scope="module")
def chosen(batch):
    return single_loads.choose(batch, 0.1)


def test_the_load_is_that_with_the_nearest_deflection(batch):
    largest = single_loads.largest_displacements(batch)
    for k, deflection in enumerate(largest.tolist()):
        assert single_loads.choose(batch, deflection * (1 + 1e-9)) == k
    assert single_loads.choose(batch, 1e3) == int(largest.argmax())


def test_an_error_of_one_percent_has_40_db(scene, batch, chosen):
    """With u = 1.01 v, relative L2 is 0.01, e_max is 0.01 max |v| and the SNR is 20 log10(101)."""
    exact = batch.displacement[chosen]
    rows, found = single_loads.measure({"near": lambda load: 1.01 * exact[None]}, batch, chosen)
    (row,) = rows
    assert (row.method, row.load) == ("near", chosen)
    assert row.rel_L2 == pytest.approx(0.01)
    assert row.e_max == pytest.approx(0.01 * row.deflection)
    assert pytest.approx(40.0864, abs=1e-3) == row.SNR
    assert torch.equal(found["near"], 1.01 * exact[None])
    metrics = ErrorMetrics(scene.problem)
    metrics.update(found["near"], Sample(*(column[chosen : chosen + 1] for column in batch)))
    expected = {name: float(value) for name, value in metrics.compute().items()}
    assert row.e_mean == pytest.approx(expected["e_mean"])
    assert row.e_max == pytest.approx(expected["e_max"])


def test_the_paper_s_single_loads_are_named():
    assert set(single_loads.PAPER) < set(PAPER)
    rows = single_loads.paper("beam_svk")
    assert [row.load for row in rows] == [None, None]
    assert rows[1].rel_L2 == pytest.approx(0.0098, abs=1e-4), "40.2 dB"
    assert single_loads.paper("mine") == []


def test_a_small_picture_is_drawn(scene, batch, chosen, tmp_path):
    exact = batch.displacement[chosen]
    networks = {"near": lambda load: 1.01 * exact[None], "far": lambda load: 1.1 * exact[None]}
    rows, found = single_loads.measure(networks, batch, chosen)
    rows = [*single_loads.paper("beam_svk"), *rows]
    single_loads.draw(scene, batch, found, rows, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size < 300_000
    width, height = Image.open(tmp_path / "a.png").size
    assert width > 2 * height

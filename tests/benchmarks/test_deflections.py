"""Laws of deflections: those of the data set's test loads, and of the experiments' bodies."""

import matplotlib.image
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from benchmarks import deflections, mechanics, peers
from benchmarks.tables import read
from dpl.evaluation.tables import write
from dpl.fem import SaintVenantKirchhoff


@pytest.fixture(scope="module")
def rows(scene):
    return deflections.deflections({"a": scene, "b": scene}, 4, 0)


def test_deflections_are_those_of_the_test_loads_of_a_data_set(rows, data):
    truth = data.samples("test").displacement.norm(dim=2).amax(dim=1)
    for body in ("a", "b"):
        mine = [row for row in rows if row.body == body]
        assert [row.load for row in mine] == [0, 1, 2, 3]
        assert [row.deflection for row in mine] == pytest.approx(truth.tolist(), rel=1e-6)
    assert {body: len(values) for body, values in deflections.by_body(rows).items()} == {
        "a": 4,
        "b": 4,
    }


def test_loads_that_are_not_accepted_are_left_out(scene, monkeypatch):
    def answered(scene, jobs, *, workers):
        for outcome in peers.solve_loads(scene, jobs, workers=workers):
            yield outcome._replace(accepted=outcome.job.number != 1)

    monkeypatch.setattr(deflections, "solve_loads", answered)
    found = deflections.deflections({"a": scene}, 3, 0)
    assert [row.load for row in found] == [0, 2]


def test_rows_and_histograms_are_written(rows, tmp_path):
    write(rows, tmp_path / "deflections.csv")
    again = read(deflections.Deflection, tmp_path / "deflections.csv")
    assert [row.load for row in again] == [row.load for row in rows]
    deflections.draw(rows, tmp_path / "deflections.png")
    pixels = matplotlib.image.imread(tmp_path / "deflections.png")
    assert pixels.shape[1] > 2 * pixels.shape[0]
    assert np.ptp(pixels[..., :3]) > 0.5


def test_figures_are_drawn_again_from_the_rows_of_a_folder(rows, tmp_path):
    write(rows, tmp_path / "deflections.csv")
    mechanics.figures(OmegaConf.create({"folder": str(tmp_path)}))
    assert sorted(path.name for path in tmp_path.glob("*.png")) == ["deflections.png"]


@pytest.mark.parametrize(
    ("experiment", "build"),
    [
        ("beam_svk", lambda: peers.beam_scene(SaintVenantKirchhoff(0.3))),
        ("propeller_nh", peers.propeller_scene),
    ],
)
def test_bodies_are_those_of_the_experiments(scene_of, experiment, build):
    theirs, ours = scene_of(f"experiment={experiment}"), build()
    loads = [scene.loads.sample((0, 2), range(2)).force for scene in (theirs, ours)]
    assert theirs.problem.length == ours.problem.length
    assert torch.allclose(*loads, rtol=1e-9, atol=1e-12 * float(loads[0].abs().max()))

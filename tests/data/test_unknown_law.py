"""Pairs of a body whose law is not known: networks learn them, and nothing else is claimed."""

import json

import numpy as np
import pytest
import torch

import dpl
import dpl.fem as fem
from dpl.visualization import plot_misfits

BODY = ["mesh=beam", "mesh.nodes=[5,3,3]", "mesh.size=[1.0,0.25,0.25]", "young=1e6"]
DATA = ["data=files", "data.path=pairs.npz", "data.val=4", "data.test=4", "data.batch_size=8"]
UNKNOWN = [*BODY, "material=unknown", "material.poisson=0.3"]


@pytest.fixture(scope="module")
def pairs():
    """Forces [N] and displacements [m] of a law with fibres."""
    fibres = fem.Guccione(c=0.2, bf=8.0, bt=2.0, bfs=4.0)
    directions = fem.ConstantFibres([2.0, 1.0, 0.0])
    law = fem.FibreReinforced(fem.VolumetricK2(bulk=2.0), fibres, directions).normalised()
    mesh = fem.box(size=(1.0, 0.25, 0.25), nodes=(5, 3, 3))
    solver = fem.Newton(fem.Problem.build(mesh, law, fixed=fem.Plane(0, 0.0)), 1e-9)
    load = fem.ModalLoads(solver.linear_solver, deflection=0.1).sample(0, range(24))
    u = torch.cat([fem.solve(solver, one).displacement for one in load.unbatch()])
    return {"force": 1e6 * load.force.numpy(), "displacement": u.numpy()}


@pytest.fixture
def folder(pairs, tmp_path):
    """A working directory with a file of pairs."""
    np.savez(tmp_path / "pairs.npz", **pairs)
    return tmp_path


def test_a_run_on_an_unknown_law_states_errors_of_test_loads_alone(script, folder, pairs):
    run = [*UNKNOWN, *DATA, "model=fcnn", "trainer.max_epochs=2", "run=runs/a"]
    ended = script("train", *run, cwd=folder)
    assert ended.status == 0, ended.err[-2000:]
    assert "law unknown; the linear solution misses the smallest by" in ended.out
    assert (folder / "runs/a/pairs.png").is_file()
    rows = json.loads((folder / "runs/a/evaluation.json").read_text())
    assert {row["solver"] for row in rows} == {"linear", "prediction"}
    assert all(np.isnan([row["errors"]["residual"], row["estimated_error"]]).all() for row in rows)
    sim, force = dpl.load(folder / "runs/a"), pairs["force"][0]
    answer = sim(force)
    assert np.isnan([answer.residual, answer.error]).all()
    assert answer.volume_ratio > 0
    assert not answer.converged
    assert answer.summary.startswith("residual and error of the displacement unknown")
    assert sim(3 * force).out_of_distribution
    assert sim(0 * force).summary == "no load: at rest"
    for request in ({"tol": 1e-3}, {"error": 0.1}, {"budget_ms": 9.0}, {"stability": True}):
        with pytest.raises(ValueError, match="needs the law of the body"):
            sim(force, **request)
    with pytest.raises(ValueError, match="grasp needs the law of the body"):
        _ = sim.grasp
    for command in ("evaluate", "export"):
        outputs = ["outputs=[results,dataset,publish]"] if command == "export" else []
        ended = script(command, "run=runs/a", *outputs, cwd=folder)
        assert ended.status == 0, ended.err[-2000:]
    assert np.isfinite(dpl.load(folder / "runs/a/export/published")(force).displacement).all()


@pytest.mark.parametrize(
    ("command", "options", "match"),
    [
        ("train", [*DATA, "model=unrolled"], "model: Unrolled needs the law"),
        ("train", [*DATA, "model=fcnn", "loss=lr_star"], "loss LrStar needs the law"),
        ("train", [*DATA, "model=fcnn", "loss=energy"], "loss PotentialEnergyLoss needs the law"),
        ("train", ["model=fcnn"], "a data set other than data=files needs the law"),
        ("generate", [], "generation of a data set needs the law"),
    ],
)
def test_what_needs_the_law_is_refused_in_one_line(script, folder, command, options, match):
    ended = script(command, *UNKNOWN, *options, cwd=folder)
    assert ended.status == 2
    assert match in ended.err
    assert len(ended.err.strip().splitlines()) == 1


def test_the_figure_of_pairs_has_a_series_of_each_law_and_the_limit():
    size = torch.tensor([0.01, 0.1, 0.2])
    figure = plot_misfits(size, {"law": size, "best": size / 10}, "relative residual", limit=1e-3)
    figure.draw_without_rendering()
    (ax,) = figure.axes
    law, best, limit = (line.get_ydata() for line in ax.lines)
    assert (np.asarray(law) > np.asarray(best)).all()
    assert set(limit) == {1e-3}
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["law", "best", "limit 0.001"]

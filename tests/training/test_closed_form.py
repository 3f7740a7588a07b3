"""Laws of fits in closed form: loads that are solved from the predictions of an earlier fit."""

from dataclasses import dataclass, replace

import pytest
import torch

from dpl.data import DataModule, DataSet, Growing, Stored, sources
from dpl.data.storage import store as store_module
from dpl.fem import Newton
from dpl.models import Unrolled
from dpl.training import MSE, Surrogate, closed_form, fit

SIZES = {"val": 6, "test": 4}
LOADS = 24


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Fits begin with eight loads; the number of threads, which growth changes, is restored."""
    for module in (sources, store_module):
        monkeypatch.setattr(module, "SHARD_SIZE", 8)
    monkeypatch.setattr(sources, "MIN_REST", 8)
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize(("grows", "workers"), [(False, 0), (True, 1)])
def test_loads_solved_from_predictions_are_those_solved_from_rest(
    scene, tmp_path, monkeypatch, capsys, grows, workers
):
    starts, iterate = [], Newton.iterate
    scene.is_compact, scene.is_softened  # noqa: B018  # solve loads by Newton's method

    def counted(newton, load, **options):
        starts.append(load)
        return iterate(newton, load, **options)

    monkeypatch.setattr(Newton, "iterate", counted)
    source = Growing(error=1e-12, max_train=LOADS) if grows else Stored(LOADS)
    data = DataModule(scene, folder=tmp_path / "d", train=source, workers=workers, **SIZES)
    surrogate = Surrogate(Unrolled(scene, rank=12, cells=8, stages=1), MSE(), scene)
    fit(surrogate, data)
    data.teardown("fit")
    if not workers:
        assert 8 + 6 <= len(starts) < 8 + 6 + 4, "few loads after the first fit"
    monkeypatch.undo()
    rest = DataSet(scene, str(tmp_path / "e"), train=LOADS, workers=0, **SIZES).fill()
    assert not data.store.missing("train", LOADS)
    for split, count in [("train", LOADS), *SIZES.items()]:
        found, expected = data.store.load(split, count), rest.load(split, count)
        assert torch.equal(found.force, expected.force)
        error = (found.displacement - expected.displacement).norm()
        assert error < 1e-6 * expected.displacement.norm()
    assert "8 loads" in capsys.readouterr().out
    again = Surrogate(Unrolled(scene, rank=12, cells=8, stages=1), MSE(), scene)
    again.net.fit(rest.load("train", LOADS), rest.load("val", SIZES["val"]))
    errors = [
        closed_form.errors_on(one, [rest.load("test", SIZES["test"])])["val/e_mean"]
        for one in (surrogate, again)
    ]
    assert errors[0] == pytest.approx(errors[1], rel=1e-2)


@dataclass(frozen=True, eq=False)
class OwnSolver:
    """A reference solver that is not Newton's method."""

    newton: Newton
    problem = property(lambda self: self.newton.problem)
    tol = property(lambda self: self.newton.tol)
    linear_solver = property(lambda self: self.newton.linear_solver)

    def iterate(self, load):
        return self.newton.iterate(load)

    def identity(self):
        return {"name": "own"}


@pytest.mark.parametrize("kind", ["own solver", "far from K(0)"])
def test_no_prediction_is_used_for_an_own_solver_or_where_the_tangent_is_far(
    make_scene, scene, kind
):
    own = make_scene() if kind == "far from K(0)" else scene
    if kind == "own solver":
        own = replace(scene, solver=OwnSolver(scene.solver))
    else:
        vars(own)["is_compact"] = False
    surrogate = Surrogate(Unrolled(own, rank=12, cells=8, stages=1), MSE(), own)
    assert closed_form._copy_for_solves(surrogate) is None

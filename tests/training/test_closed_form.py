"""Laws of fits in closed form: they do not depend on how the loads were solved."""

import pytest

from dpl.data import DataModule
from dpl.models import Unrolled
from dpl.training import MSE, Surrogate, fit

SIZES = {"train": 24, "val": 6, "test": 4, "workers": 0}


def test_a_fit_does_not_depend_on_the_iterations_that_solved_its_loads(make_scene, tmp_path):
    """Anderson iterations, and Newton's method from rest."""
    errors, sets = [], []
    for compact in (True, False):
        scene = make_scene()
        vars(scene)["is_compact"] = compact
        data = DataModule(scene, folder=str(tmp_path / f"{compact}"), **SIZES)
        surrogate = Surrogate(Unrolled(scene, rank=12, cells=8, stages=1), MSE(), scene)
        errors.append(fit(surrogate, data))
        sets.append(data.store.load("train", SIZES["train"]))
    assert sets[0].force.equal(sets[1].force), "the same loads are accepted"
    difference = (sets[0].displacement - sets[1].displacement).norm()
    assert 0 < difference < 1e-7 * sets[1].displacement.norm()
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)

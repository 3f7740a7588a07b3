"""Laws of fits in closed form: they do not depend on how the loads were solved."""

import multiprocessing
from types import SimpleNamespace

import pytest

from dpl.data import DataModule
from dpl.models import Unrolled
from dpl.training import MSE, Surrogate, closed_form, fit

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


def test_kernels_are_compiled_by_another_process_only_where_loads_have_to_be_solved(
    make_scene, tmp_path, monkeypatch
):
    """The numbers of a fit do not depend on it, and no process is left."""
    scene, errors, started = make_scene(), [], []
    ahead = closed_form._compiled_ahead

    def recorded(*arguments):
        started.append(ahead(*arguments))
        return started[-1]

    monkeypatch.setattr(closed_form, "_compiled_ahead", recorded)
    for misses in ({}, {"a signature": 1}, {"a signature": 1}):
        kernel = SimpleNamespace(stats=SimpleNamespace(cache_misses=misses))
        monkeypatch.setattr(closed_form, "add_system", kernel)
        folder = tmp_path / ("known" if misses else "first")
        data = DataModule(scene, folder=str(folder), **{**SIZES, "workers": 1})
        surrogate = Surrogate(Unrolled(scene, rank=12, cells=8, stages=1), MSE(), scene)
        errors.append(fit(surrogate, data))
    assert [one is not None for one in started] == [False, True, False]
    assert len(set(errors)) == 1
    assert not multiprocessing.active_children()

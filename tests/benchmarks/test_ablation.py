"""Laws of the ablation: variants lack what their names say; errors are those of the model."""

import pytest

from benchmarks import ablation
from benchmarks.samples import solved
from dpl.models import Unrolled


@pytest.fixture(scope="module")
def build(scene):
    return lambda **options: Unrolled(scene, **{"rank": 40, "cells": 16, "stages": 1, **options})


@pytest.fixture(scope="module")
def sets(scene):
    """Samples to fit to, and unseen ones."""
    return [solved(scene, scene.loads.sample(k, range(n))) for k, n in ((0, 40), (1, 9))]


def fitted(variant, build, sets):
    samples, unseen = sets
    return ablation.fitted(variant, build, samples, unseen, unseen, ablation.ABLATION)


@pytest.mark.parametrize("left_out", ["R^T dP", "dP"])
def test_a_stress_that_is_left_out_has_no_effect(build, sets, left_out, monkeypatch):
    kept = next(name for name in ablation.STRESSES if name != left_out)
    variant = next(one for one in ablation.variants({}) if one.name == f"{kept} only")
    monkeypatch.setattr(Unrolled, "_is_compiled", lambda *_: False)  # as in an ablation
    _, net = fitted(ablation.WHOLE, build, sets)
    assert len(net.maps) == 1
    force, dim = sets[1].force, net.gradients.shape[-1]
    by_stress = net.maps[0].unflatten(0, (-1, 2, dim * dim))
    for name, has_effect in ((left_out, False), (kept, True)):
        with variant.change():
            before = net(force)
            by_stress[:, ablation.STRESSES[name]] *= 2
            net._prepare()
            assert bool((net(force) != before).any()) == has_effect


def test_a_variant_is_fitted_in_its_context(build, sets):
    names = ("R^T dP only", "dP only")
    variants = [one for one in ablation.variants({}) if one.name in names]
    rows = [fitted(variant, build, sets)[0] for variant in (ablation.WHOLE, *variants)]
    assert len({row.e_mean for row in rows}) == 3

"""Laws of the ablation: variants lack what their names say; errors are those of the model."""

import pytest

from benchmarks import ablation
from benchmarks.samples import solved
from dpl.models import Unrolled


@pytest.fixture(scope="module")
def build(scene):
    return lambda **options: Unrolled(scene, **{"rank": 12, "cells": 4, "stages": 1, **options})


@pytest.fixture(scope="module")
def sets(scene):
    """Samples to fit to, and unseen ones."""
    return [solved(scene, scene.loads.sample(k, range(n))) for k, n in ((0, 24), (1, 9))]


def fitted(variant, build, sets):
    samples, unseen = sets
    return ablation.fitted(variant, build, samples, unseen, unseen, ablation.ABLATION)


@pytest.mark.parametrize("left_out", ["R^T dP", "dP"])
def test_a_stress_that_is_left_out_has_zero_maps(build, sets, left_out):
    kept = next(name for name in ablation.STRESSES if name != left_out)
    variant = next(one for one in ablation.variants({}) if one.name == f"{kept} only")
    _, net = fitted(variant, build, sets)
    _, whole = fitted(ablation.WHOLE, build, sets)
    for one, is_zero in ((net, True), (whole, False)):
        assert len(one.maps) == 1
        dim = one.gradients.shape[-1]
        by_stress = one.maps[0].unflatten(0, (-1, 2, dim * dim))
        assert bool((by_stress[:, ablation.STRESSES[left_out]] == 0).all()) == is_zero
        assert by_stress[:, ablation.STRESSES[kept]].abs().max() > 0

"""Laws of the ablation: variants lack what their names say; errors are those of the model."""

import pytest
import torch

from benchmarks import ablation
from benchmarks.samples import solved
from dpl.models import Unrolled
from dpl.training import ErrorMetrics


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


def test_errors_are_those_of_the_predictions_and_of_a_newton_step(build, sets, monkeypatch):
    monkeypatch.setattr(Unrolled, "_is_compiled", lambda *_: False)  # as in an ablation
    row, net = fitted(ablation.Variant("", {"rank": 40, "stages": 0}), build, sets)
    test = sets[1]
    predicted, solver = net(test.force), net.correction()
    pairs = list(zip(test.load.unbatch(), predicted.split(1), strict=True))
    ends = [list(solver.states(load, guess=u, max_iter=1))[-1] for load, u in pairs]
    corrected = torch.cat([end.displacement for end in ends])
    for load, u in pairs:
        first, *_, last = solver.states(load, guess=u, max_iter=4)  # the first may go too far
        assert last.error < 0.2 * first.error
    for field, e_mean, worst in (
        (predicted, row.e_mean, row.rel_L2_worst),
        (corrected, row.e_mean_corrected, row.rel_L2_worst_corrected),
    ):
        metrics = ErrorMetrics(net.scene.problem)
        metrics.update(field, test)
        known = metrics.compute()
        assert e_mean == pytest.approx(float(known["e_mean"]), rel=1e-6)
        assert worst == pytest.approx(float(known["rel_L2_worst"]), rel=1e-6)

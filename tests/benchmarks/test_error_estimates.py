"""Laws of the calibration: estimates are those of the simulator, quantiles those of the ratios."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import error_estimates
from benchmarks.error_estimates import Estimate, measured, summarised
from benchmarks.samples import first
from dpl.fem import solve
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate


def test_errors_are_those_of_the_answers(scene, batch):
    samples = first(batch, 4)
    surrogate = Surrogate(FCNN(scene, width=4), MSE(), scene)
    surrogate.predict = lambda load: 0.99 * solve(scene.solver, load).displacement
    found = list(measured(Simulator(surrogate), samples, {}))
    assert [one.error for one in found] == pytest.approx([0.01] * 4, rel=1e-6)
    answer = Simulator(surrogate)(**scene.si_inputs(samples.load))
    assert [one.estimated for one in found] == pytest.approx(answer.error.tolist())
    assert {one.method for one in found} == {"prediction"}
    better = list(measured(Simulator(surrogate), samples, {"tol": 1e-6}))
    assert all(one.error < 1e-5 for one in better)


def test_softened_bodies_are_stable_and_nearer_to_buckling_than_others():
    scene = error_estimates.BODIES["beam"]()
    found = error_estimates.softened(scene, 2)
    assert list(found) == ["compressed", "twisted", "pinched"]
    assert all(len(some.force) for some in found.values())
    soft, usual = (
        min(scene.linear.smallest_ritz_value(u[None]) for u in states)
        for states in (found["compressed"].displacement, [u[0] for _, u in scene._typical_states])
    )
    assert 0 < soft < usual


def test_quantiles_are_those_of_finite_ratios_of_each_group():
    ratios = np.linspace(1.0, 3.0, 21)
    group = [Estimate("a", "b", "c", "", "prediction", 0.01, 0.01 * r) for r in ratios]
    lost = replace(group[0], estimated=math.inf)
    wrong = [replace(group[0], prediction="d", estimated=0.01 * part) for part in (0.2, 0.5)]
    exact = replace(group[0], error=0.0, estimated=1e-12)
    first, second = summarised([*group, lost, exact, *wrong])
    assert (first.count, first.unknown, second.count, second.unknown) == (22, 1, 2, 0)
    assert (first.p5, first.median, first.p95) == pytest.approx((1.1, 2.0, 2.9))
    assert (first.least, first.missed) == (pytest.approx(1.0), 0)
    assert (second.least, second.missed) == (pytest.approx(0.2), 1)

"""Laws of the benchmark of grasps."""

import numpy as np
import pytest
import torch

from benchmarks import grasps
from dpl.fem import RigidPatch
from dpl.inference import Gripper
from dpl.models import FCNN
from dpl.training import MSE, Surrogate


@pytest.fixture(scope="module")
def gripper(scene):
    """Gripper whose network is the linear solution."""
    surrogate = Surrogate(FCNN(scene, width=4), MSE(), scene)
    surrogate.predict = lambda load: torch.stack([scene.linear.solve(f) for f in load.force])
    return Gripper(surrogate, steps=6)


@pytest.fixture(scope="module")
def some(scene):
    return list(grasps.random_grasps(scene, 4))


def test_the_linear_energy_is_at_most_that_of_the_training(scene, some):
    loads = scene.loads.sample((0, 9), range(grasps.LOADS)).force
    largest = max(float((f * scene.linear.solve(f)).sum()) for f in loads)
    for grasp in some:
        patch = RigidPatch.of(scene.linear, grasp.region, [True] * 3)
        motion = np.concatenate([np.array(grasp.translation) / scene.length, grasp.rotation])
        energy = motion @ grasps.rigid_stiffness(patch) @ motion
        assert 0 < energy <= largest * (1 + 1e-6)


def test_better_methods_have_smaller_errors(gripper, some):
    rows, unknown = grasps.measure(gripper, some)
    network, corrected, hybrid, newton = sorted(rows, key=lambda row: -row.rel_L2_median)
    assert unknown == 0
    assert network.method == "prediction"
    assert corrected.method == "corrected"
    assert {hybrid.method, newton.method} == {"hybrid to 1e-6", grasps.NEWTON}
    assert corrected.motion_met == hybrid.motion_met == newton.motion_met == 100
    assert hybrid.converged == newton.converged == 100
    assert hybrid.force_worst < 1e-5
    assert all(row.silent == 0 for row in rows)
    assert all(row.found == 100 for row in rows)
    assert all(row.count == 4 for row in rows)


def test_an_error_that_is_not_reported_is_counted():
    row = [0.5, 0.0, 0.0, 0.0, 1.0, 0.5, 1.0, 1.0, 1.0]  # error and estimate agree
    silent = [0.5, 0.0, 0.0, 0.0, 1.0, 0.1, 1.0, 1.0, 1.0]
    unknown = [0.5, 0.0, 0.0, 0.0, 1.0, np.nan, 1.0, 1.0, 1.0]
    assert grasps._row("a", np.array([row, silent, unknown])).silent == 2


def test_the_error_of_a_linear_network_has_slope_two(gripper, some):
    rows = grasps.against_amplitude(gripper, some)
    assert [row.amplitude for row in rows] == [2.0**-k for k in range(grasps.HALVINGS + 1)]
    assert grasps.slope(rows) == pytest.approx(2, abs=0.3)


def test_a_hand_that_moves_is_accurate_in_each_frame(gripper, some):
    (hand,) = grasps.moving_hands(gripper.surrogate, some[:2], [None], steps=6, frames=20)
    assert (hand.frames, hand.late) == (40, 0)
    assert hand.rel_L2_worst < 1e-2
    assert hand.rel_L2_median < 1e-3
    assert 0 < hand.p50_ms <= hand.p99_ms

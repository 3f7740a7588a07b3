"""Requests of loads and grasps: interpolation, answers and the load on the body."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dpl.viewer.frames import ERROR, ViewSettings, arrow_ends
from dpl.viewer.hands import GraspingHand
from dpl.viewer.requests import GRASP_LIMIT_MS, distance, interpolate, scale_of

EXACT = ViewSettings(tol=1e-8)
UP = torch.tensor([0.0, 0.0, 0.08]).double()
TURN = torch.tensor([0.0, -0.1, 0.0]).double()


def tip_patch(body, radius=0.3):
    node = int(body.surface.nodes[body.surface.undeformed[:, 0].argmax()])
    return body.patch(node, radius)


@pytest.fixture
def grasp(body):
    """A grasp of the tip, which moves and rotates."""
    return body.grasp(tip_patch(body).held_nodes, UP, TURN)


def test_requests_are_interpolated_with_their_moduli(body, grasp):
    old, new = body.sample(0), body.sample(1)
    assert interpolate(old, new, 1.0) is new
    assert torch.allclose(interpolate(old, new, 0.5).force, (old.force + new.force) / 2)
    young = 2 * body.young
    goal = body.with_moduli(body.grasp(grasp.nodes, 3 * UP, -TURN), young)
    assert interpolate(grasp, goal, 1.0) is goal
    middle = interpolate(grasp, goal, 0.25)
    assert torch.allclose(middle.translation, 1.5 * UP)
    assert torch.allclose(middle.rotation, 0.5 * TURN)
    assert middle.young == pytest.approx(1.25 * body.young)
    assert torch.equal(middle.nodes, grasp.nodes)
    rest = grasp.at(0 * grasp.coordinates)
    scale = scale_of(rest, grasp)
    assert scale == pytest.approx(float(torch.cat([UP, TURN]).norm())), "the larger motion"
    assert distance(rest, grasp, scale) == pytest.approx(1)
    assert distance(interpolate(rest, grasp, 0.75), grasp, scale) == pytest.approx(0.25)
    softer = grasp.with_moduli(0.5 * grasp.young, grasp.parameters)
    assert distance(softer, grasp, scale) == pytest.approx(0.5)
    assert scale_of(rest, rest) == 1.0


def test_a_request_continues_only_another_one_of_the_same_patch_and_kind(body, grasp):
    other = body.grasp(tip_patch(body, 0.1).held_nodes, UP, TURN)
    assert not torch.equal(other.nodes, grasp.nodes)
    assert grasp.continues(grasp.at(0 * grasp.coordinates))
    assert not grasp.continues(other)
    assert not grasp.continues(body.sample(1))
    assert not body.sample(1).continues(grasp)
    assert body.sample(1).continues(body.zero_load())
    sliding = grasp._replace(sliding=True)
    assert sliding.continues(sliding.at(sliding.coordinates))
    assert not sliding.continues(grasp)


@pytest.mark.parametrize("settings", [ViewSettings(), EXACT], ids=["prediction", "1e-8"])
def test_a_grasped_patch_moves_as_a_rigid_body(body, grasp, settings):
    frame = body.solve(grasp, settings)
    points = body.scene.problem.points[grasp.nodes]
    moved = points + frame.displacement[grasp.nodes] / body.scene.length
    assert torch.allclose(moved.mean(dim=0), points.mean(dim=0) + UP, atol=1e-3)
    assert torch.allclose(torch.cdist(moved, moved), torch.cdist(points, points), atol=1e-3)
    arm = points - points.mean(dim=0)
    turned = moved - moved.mean(dim=0)
    # a rotation by a negative angle about y lifts what lies ahead along x
    ahead = int(arm[:, 0].argmax())
    lifted = np.sin(0.1) * arm[ahead, 0] + np.cos(0.1) * arm[ahead, 2]
    assert float(turned[ahead, 2]) == pytest.approx(float(lifted), abs=1e-3)
    assert frame.grasp is frame.answer
    start, end = arrow_ends(body.surface, frame)
    direction = (end - start) / np.linalg.norm(end - start)
    force = np.linalg.norm(frame.grasp.force)
    assert direction == pytest.approx(frame.grasp.force / force), "the arrow of the gripper"
    equal = body.scene.loads.largest_force * float(grasp.nodes.sum()) ** 0.5  # along one axis
    assert frame.amplitude == pytest.approx(force / (body.young * body.scene.force_unit * equal))


def test_the_load_of_a_grasp_has_its_displacement(make_scene, make_body):
    """The forces of the gripper and the constant forces balance the body, at any modulus."""
    weight = torch.zeros(45, 3).double()
    weight[:, 1] = -2e-7
    body = make_body(make_scene(constant_force=weight))
    young = 2 * body.young
    request = body.with_moduli(body.grasp(tip_patch(body).held_nodes, UP, TURN), young)
    frame = body.solve(request, EXACT)
    assert frame.converged
    gripper = torch.from_numpy(frame.grasp.nodal_force)
    constant = weight * (body.young * body.scene.force_unit)
    assert torch.allclose(frame.load.force, gripper + constant)
    assert not gripper[~request.nodes].any()
    assert torch.equal(frame.hand_force, gripper)
    assert frame.load.young == young
    again = body.solve(frame.load, EXACT)
    assert again.converged
    assert torch.allclose(again.displacement, frame.displacement, atol=1e-6 * 8.0)


@pytest.mark.parametrize("more", [{}, {"poisson": [0.2, 0.4]}], ids=["one law", "range"])
def test_newtons_iterates_of_a_grasp_converge_to_its_displacement(make_scene, make_body, more):
    body = make_body(make_scene(**more))
    grasp = body.grasp(tip_patch(body).held_nodes, UP, TURN)
    frame = body.solve(grasp, EXACT)
    iterates = list(body.newton_frames(grasp, EXACT, frame))
    assert len(iterates) > 2
    assert iterates[-1].converged
    assert all(state.grasp is None and state.request is grasp for state in iterates)
    assert torch.allclose(iterates[-1].displacement, frame.displacement, atol=1e-6 * 8.0)


def test_the_error_of_a_grasp_is_against_the_same_motion(body, grasp, monkeypatch):
    values = body.solve(grasp, ViewSettings(quantity=ERROR)).values
    assert 0 < values.max() < 0.1 * float(UP[2]) * body.scene.length
    assert body.solve(grasp, ViewSettings(quantity=ERROR, tol=1e-8)).values.max() < 1e-5
    monkeypatch.setattr("dpl.viewer.requests.GRASP_LIMIT_MS", 1e-3)
    with pytest.raises(ValueError, match="no finite-element solution of this grasp after"):
        body.solve(grasp, ViewSettings(quantity=ERROR))


def fixed_patch(body):
    return body.patch(int(body.surface.nodes[body.surface.undeformed[:, 0].argmin()]), 0.01)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda body: body.grasp(fixed_patch(body).held_nodes, UP, TURN), "no free node of the"),
        (
            lambda body: body.grasp(tip_patch(body, 0.01).sliding_nodes, UP, TURN, sliding=True),
            "the patch has no facet across x, y or z",
        ),
        (
            lambda body: body.solve(
                body.grasp(tip_patch(body).held_nodes, math.nan * UP, TURN), ViewSettings()
            ),
            "all finite",
        ),
        (lambda body: body.with_moduli(body.zero_load(), 1.0), "young = 1 must lie between"),
        (lambda body: ViewSettings(quantity="heat"), "quantity = 'heat'"),
        (lambda body: ViewSettings(tol=math.nan), "tol = nan"),
    ],
)
def test_invalid_values_are_refused(body, make, words):
    with pytest.raises(ValueError, match=words):
        make(body)


def test_a_sliding_patch_moves_along_its_normal_alone(body):
    nodes = tip_patch(body).sliding_nodes
    motion = torch.tensor([0.05, 0.3, 0.3]).double()
    frame = body.solve(body.grasp(nodes, motion, 0 * TURN, sliding=True), EXACT)
    moved = frame.displacement[nodes] / body.scene.length
    assert frame.converged
    assert torch.allclose(moved[:, 0], motion[0].expand(int(nodes.sum())), atol=1e-9)
    assert moved[:, 1:].abs().max() < 0.05
    assert not frame.hand_force[:, 1:].any()
    *_, last = body.newton_frames(frame.request, EXACT, frame)
    assert torch.allclose(last.displacement, frame.displacement, atol=1e-6 * 8.0)


def test_a_grasp_without_a_budget_has_the_limit_of_the_page(body, grasp):
    asked = []
    simulator = SimpleNamespace(
        scene=body.scene, grasp=lambda *motion, **options: asked.append(options["budget_ms"])
    )
    grasp.answer(simulator, None)
    grasp.answer(simulator, 1e-8, 20.0)
    assert asked == [GRASP_LIMIT_MS, 20.0]


def test_a_hand_takes_a_patch_where_the_body_is_shown(body):
    problem, whole = body.scene.problem, tip_patch(body, 2.0).held_nodes
    assert torch.equal(whole, problem.boundary & problem.free.any(dim=1))
    assert whole.sum() < len(whole)
    rotation = torch.zeros(3).double()
    controls = SimpleNamespace(
        radius=SimpleNamespace(value=0.3),
        angle=SimpleNamespace(value=5.0),
        sliding=SimpleNamespace(value=False),
        rotation=rotation,
    )
    hand, patch = GraspingHand(body, controls), tip_patch(body)
    frame = body.solve(body.sample(1), EXACT)
    assert hand.take(patch.node, frame) == patch.node
    assert controls.angle.value == 0.0
    request = hand.move(UP)()
    mean = frame.displacement[patch.held_nodes].mean(dim=0) / body.scene.length
    assert mean.norm() > 0.01
    assert torch.allclose(request.translation, mean + UP)
    other = int(torch.nonzero(patch.held_nodes)[0])
    assert other != patch.node
    assert hand.take(other, frame) == patch.node, "a drag within the patch keeps it"
    again = hand.move(UP)()
    assert torch.allclose(again.translation, mean + 2 * UP)
    assert torch.equal(again.nodes, request.nodes)
    hand.release()
    assert hand.take(other, frame) == other

"""Requests of loads and grasps: interpolation, answers and the load on the body."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from dpl.viewer.frames import ERROR, ViewSettings

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
    assert torch.allclose(old.interpolate(new, 0.5).force, (old.force + new.force) / 2)
    goal = replace(grasp, translation=3 * UP, rotation=-TURN, young=2 * body.young)
    middle = grasp.interpolate(goal, 0.25)
    assert torch.allclose(middle.translation, 1.5 * UP)
    assert torch.allclose(middle.rotation, 0.5 * TURN)
    assert middle.young == pytest.approx(1.25 * body.young)
    rest = body.grasp(grasp.nodes, 0 * UP, 0 * TURN)
    assert rest.distance(grasp) == pytest.approx(1)
    assert rest.interpolate(grasp, 0.75).distance(grasp) == pytest.approx(0.25)
    assert replace(grasp, young=0.5 * grasp.young).distance(grasp) == pytest.approx(0.5)
    assert rest.distance(rest) == 0


def test_a_request_continues_only_another_one_of_the_same_patch_and_kind(body, grasp):
    other = body.grasp(tip_patch(body, 0.1).held_nodes, UP, TURN)
    assert not torch.equal(other.nodes, grasp.nodes)
    assert grasp.continues(replace(grasp, translation=0 * UP))
    assert not grasp.continues(other)
    assert not grasp.continues(body.sample(1))
    assert not body.sample(1).continues(grasp)
    assert body.sample(1).continues(body.zero_load())
    assert not replace(grasp, sliding=True).continues(grasp)


def test_the_arrow_and_the_amplitude_of_a_grasp_are_those_of_its_force(body, grasp):
    frame = body.solve(grasp, ViewSettings())
    start, end = body.arrow_ends(frame)
    direction = (end - start) / np.linalg.norm(end - start)
    force = np.linalg.norm(frame.grasp.force)
    assert direction == pytest.approx(frame.grasp.force / force)
    equal = body.scene.loads.largest_force * float(grasp.nodes.sum()) ** 0.5  # along one axis
    unit = body.young * body.scene.force_unit
    assert grasp.amplitude(frame.answer, body.scene) == pytest.approx(force / (unit * equal))


def test_the_load_of_a_grasp_has_its_displacement(make_scene, make_body):
    """The forces of the gripper and the constant forces balance the body, at any modulus."""
    weight = torch.zeros(45, 3).double()
    weight[:, 1] = -2e-7
    body = make_body(make_scene(constant_force=weight))
    young = 2 * body.young
    request = replace(body.grasp(tip_patch(body).held_nodes, UP, TURN), young=young)
    frame = body.solve(request, EXACT)
    assert frame.answer.converged
    gripper = torch.from_numpy(frame.grasp.nodal_force)
    constant = weight * (body.young * body.scene.force_unit)
    assert torch.allclose(frame.load.force, gripper + constant)
    assert not gripper[~request.nodes].any()
    assert torch.equal(request.hand_force(frame.answer), gripper)
    assert frame.load.young == young
    again = body.solve(frame.load, EXACT)
    assert again.answer.converged
    assert torch.allclose(again.displacement, frame.displacement, atol=1e-6 * 8.0)


@pytest.mark.parametrize("more", [{}, {"poisson": [0.2, 0.4]}], ids=["one law", "range"])
def test_newtons_iterates_of_a_grasp_converge_to_its_displacement(make_scene, make_body, more):
    body = make_body(make_scene(**more))
    grasp = body.grasp(tip_patch(body).held_nodes, UP, TURN)
    frame = body.solve(grasp, EXACT)
    iterates = list(body.newton_frames(grasp, EXACT, frame))
    assert len(iterates) > 2
    assert iterates[-1].answer.converged
    assert all(state.grasp is None and state.request is grasp for state in iterates)
    assert torch.allclose(iterates[-1].displacement, frame.displacement, atol=1e-6 * 8.0)


def test_the_error_of_a_grasp_is_against_the_same_motion(body, grasp, monkeypatch):
    values = body.solve(grasp, ViewSettings(quantity=ERROR)).values
    assert 0 < values.max() < 0.1 * float(UP[2]) * body.scene.length
    assert body.solve(grasp, ViewSettings(quantity=ERROR, tol=1e-8)).values.max() < 1e-5
    monkeypatch.setattr("dpl.viewer.requests.GRASP_LIMIT_MS", 1e-3)
    with pytest.raises(ValueError, match="no finite-element solution of this grasp after"):
        body.solve(grasp, ViewSettings(quantity=ERROR))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda body: body.grasp(tip_patch(body, 0.01).sliding_nodes, UP, TURN, sliding=True),
            "sliding: no facet of the patch is within",
        ),
        (lambda body: body.grasp(tip_patch(body).held_nodes, math.nan * UP, TURN), "all finite"),
        (lambda body: replace(body.zero_load(), young=-1.0), "young: a modulus is not above 0"),
    ],
)
def test_invalid_requests_are_refused(body, make, words):
    with pytest.raises(ValueError, match=words):
        body.solve(make(body), ViewSettings())


def test_an_unknown_quantity_is_refused():
    with pytest.raises(ValueError, match="quantity = 'heat' must be displacement or"):
        ViewSettings(quantity="heat")


def test_a_sliding_patch_moves_along_its_normal_alone(body):
    nodes = tip_patch(body).sliding_nodes
    motion = torch.tensor([0.05, 0.3, 0.3]).double()
    frame = body.solve(body.grasp(nodes, motion, 0 * TURN, sliding=True), EXACT)
    moved = frame.displacement[nodes] / body.scene.length
    assert frame.answer.converged
    assert torch.allclose(moved[:, 0], motion[0].expand(int(nodes.sum())), atol=1e-9)
    assert moved[:, 1:].abs().max() < 0.05
    assert not frame.request.hand_force(frame.answer)[:, 1:].any()
    *_, last = body.newton_frames(frame.request, EXACT, frame)
    assert torch.allclose(last.displacement, frame.displacement, atol=1e-6 * 8.0)

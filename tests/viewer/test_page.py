"""Pages of all kinds of bodies, without a browser: drags, clicks and controls."""

import asyncio
import contextlib
import html
import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="the extra viewer is not installed")

from dpl.fem import SubspaceNewton, rectangle
from dpl.inference import Simulator
from dpl.viewer import Body
from dpl.viewer.controls import BAD, GRASP, PULL, WARNING
from dpl.viewer.frames import QUANTITIES
from dpl.viewer.recording import rotating_load
from dpl.viewer.renderer import NEUTRAL, engineering

BODIES = {
    "hexahedra": {},
    "degree 2": {"degree": 2, "cell": "tetra"},
    "2D": {"mesh": rectangle([100.0, 25.0], [9, 4])},
    "range of Poisson's ratios": {"poisson": [0.2, 0.4]},
    "range of Young's moduli": {"young": [1e6, 3e6]},
}
BY_USER = SimpleNamespace(client=object())
of_bodies = partial(pytest.mark.parametrize, "pages", indirect=True)


@pytest.fixture(scope="module", params=["hexahedra"])
def pages(request, make_scene, make_body, make_page, tmp_path_factory):
    """A page of a body, and a function that restores it."""
    body, folder = make_body(make_scene(**BODIES[request.param])), tmp_path_factory.mktemp("page")
    page = make_page(body, folder)
    controls, node = page.controls, page.node
    switches = (controls.mode, *controls.of_load, *controls.of_moduli)
    values = [(control, control.value) for control in (*switches, *controls.of_settings)]
    assert page.worker.wait(240)

    def restore():
        for control, value in values:
            control.value = value
        page.node = node
        page.apply_mode()
        page.apply_settings(None)
        after(page, page.reset)

    yield page, restore
    page.close()


@pytest.fixture
def page(pages):
    """The page as it was at first."""
    page, restore = pages
    restore()
    return page


def problem(page):
    """Return the message about a state that cannot be used, empty if there is none."""
    page.refresh()
    line = rf'color:(?:{BAD}|{WARNING});line-height:1.35">(.*?)</div>'
    found = re.search(line, page.controls.readings.content)
    return html.unescape(found[1]) if found else ""


def after(page, action, event=None):
    """Do an action of the page and return the frame that follows."""
    action(event)
    assert page.worker.wait(240)
    page.refresh()
    return page.frame


def drag_tip(page, motion):
    """Send the drag events of a browser that moves the tip by a vector (3,)."""
    place = page.frame.points[page.body.surface.undeformed[:, 0].argmax()]
    for phase, share in (("start", 0.1), ("update", 0.6), ("end", 1.0)):
        event = SimpleNamespace(
            phase=phase, start_position=tuple(place), end_position=tuple(place + share * motion)
        )
        asyncio.run(page.drag(event))
    assert page.worker.wait(240)
    page.refresh()


@of_bodies(BODIES)
def test_a_dragged_point_follows_the_mouse(page):
    flat = page.body.scene.problem.shape[1] == 2
    drag_tip(page, np.array([0.0, 0.08, 0.0] if flat else [0.0, 0.0, 0.08]))
    frame = page.frame
    tip = frame.displacement[page.node] / page.body.scene.length
    assert tip[-1] == pytest.approx(0.08, rel=0.3)
    page.refresh()
    result, unit = page.controls.readings.content, "N/m" if flat else "N"
    assert result.index("estimated error") < result.index("total force")
    assert "min det F" in page.controls.details.content
    assert engineering(float(frame.request.force.sum(dim=0).norm()), unit) in result
    assert engineering(float(frame.displacement[page.node].norm()), "m") in result
    assert "<b>displacement</b>" in result
    assert problem(page) == ""


def select(page, mode):
    """Select the mode of drags as a browser does."""
    page.controls.mode.value = mode
    page.apply_mode()


@of_bodies(["hexahedra", "2D"])
def test_a_grasped_patch_follows_the_mouse(page):
    select(page, GRASP)
    motion = np.array([0.0, 0.04, 0.0])
    drag_tip(page, motion)
    frame, dim = page.frame, page.body.scene.problem.shape[1]
    held = page.hand.marked_nodes(page.node)
    moved = frame.displacement[held] / page.body.scene.length
    assert held.sum() > 1
    assert torch.allclose(moved, torch.from_numpy(motion[:dim]).expand_as(moved), atol=1e-4)
    assert page._marker.mask.tolist() == held[page.body.surface.nodes].tolist()
    assert page._marker.mask.any()
    assert page._marker._arrow.visible
    page.refresh()
    result, grasp = page.controls.readings.content, frame.grasp
    units = ("N", "N m") if dim == 3 else ("N/m", "N")
    for vector, unit in zip((grasp.force, grasp.moment), units, strict=True):
        assert engineering(float(np.linalg.norm(vector)), unit) in result
    details = page.controls.details.content
    assert engineering(grasp.motion_error, "m") in details
    assert html.escape(grasp.summary) in details
    assert problem(page) == ""
    drag_tip(page, motion)
    moved = page.frame.displacement[held] / page.body.scene.length
    expected = torch.from_numpy(2 * motion[:dim]).expand_as(moved)
    assert torch.allclose(moved, expected, atol=1e-4), "a second drag begins where the first ended"


@of_bodies(["hexahedra", "2D"])
def test_the_angle_rotates_a_grasped_patch(page):
    select(page, GRASP)
    drag_tip(page, np.array([0.0, 0.02, 0.0]))
    before, dim = page.frame.request, page.body.scene.problem.shape[1]
    page.controls.axis.value = "z"
    page.controls.angle.value = 6.0
    after(page, page.apply_controls, BY_USER)
    request = page.frame.request
    turn = [np.deg2rad(6.0)] if dim == 2 else [0.0, 0.0, np.deg2rad(6.0)]
    assert request.rotation.tolist() == pytest.approx(turn)
    assert torch.equal(request.translation, before.translation)
    after(page, page.sample)
    assert page.frame.grasp is None
    drag_tip(page, np.array([0.0, 0.0, 0.0]))
    assert not page.frame.request.rotation.any(), "a new grasp begins without a rotation"


@of_bodies(["hexahedra", "2D"])
def test_each_mode_has_its_controls_and_its_radius(page):
    controls = page.controls
    planar = page.body.scene.problem.shape[1] == 2
    of_pull = (controls.direction, controls.amplitude)
    controls.radii[PULL].value = 0.31
    for mode in (GRASP, PULL):
        select(page, mode)
        assert {control.visible for control in of_pull} == {mode == PULL}
        assert controls.angle.visible == controls.sliding.visible == (mode == GRASP)
        assert controls.axis.visible == (mode == GRASP and not planar)
        assert [radius.visible for radius in controls.radii.values()] == [
            mode == PULL,
            mode == GRASP,
        ]
    assert controls.radius == 0.31
    select(page, GRASP)
    assert controls.radius == 0.15
    mask = page.hand.marked_nodes(page.node)[page.body.surface.nodes]
    assert len(page._marker._dots.points) == mask.sum()


def test_a_change_of_the_mode_keeps_the_load(page):
    drag_tip(page, np.array([0.0, 0.0, 0.05]))
    frame = page.frame
    select(page, GRASP)
    assert page.worker.wait(240)
    assert page.frame is frame
    drag_tip(page, np.array([0.0, 0.0, 0.0]))
    held = page.hand.marked_nodes(page.node)
    mean = frame.displacement[held].mean(dim=0)
    assert torch.allclose(page.frame.displacement[held].mean(dim=0), mean, atol=0.01)
    select(page, PULL)
    assert after(page, page.reset).answer.method == "rest"


def test_a_patch_that_cannot_move_is_reported_in_one_line(page):
    drag_tip(page, np.array([0.0, 0.0, 0.05]))
    frame = page.frame
    select(page, GRASP)
    page.controls.radii[GRASP].value = 0.01
    event = SimpleNamespace(ray_origin=(-3.0, 0.125, 0.125), ray_direction=(1.0, 0.0, 0.0))
    asyncio.run(page.click(event))
    assert page.worker.wait(240)
    assert problem(page) == "region: no node of the boundary in it is free to move"
    assert page.frame is frame
    drag_tip(page, np.array([0.0, 0.0, 0.02]))
    assert page.frame.grasp is not None
    assert problem(page) == ""


def test_a_state_that_cannot_be_used_is_reported_in_one_line(page):
    select(page, GRASP)
    drag_tip(page, np.array([0.0, 0.0, 0.04]))
    good = page.frame
    far = replace(good.grasp, motion_error=0.5, error=0.37)
    inverted = [replace(good.grasp, volume_ratio=ratio) for ratio in (-0.1, float("nan"))]
    for answer, words in (
        *((answer, "Not valid: an element is inverted") for answer in inverted),
        (far, "estimated error 37 %, the patch is 500 mm away from the hand"),
        (good.grasp, ""),
    ):
        page._show(good._replace(answer=answer))
        found = problem(page)
        assert words in found
        assert bool(words) == bool(found)


def test_a_grasp_that_takes_too_long_is_stopped_and_reported(page, monkeypatch):
    monkeypatch.setattr("dpl.viewer.requests.GRASP_LIMIT_MS", 1e-3)
    assert page.worker.wait(240)
    select(page, GRASP)
    drag_tip(page, np.array([0.0, 0.0, 0.04]))
    assert page.frame.grasp.stopped
    assert problem(page).startswith("Not solved: stopped after 0.")
    page.controls.method.value = "best within the budget"
    page.controls.budget.value = 1e4
    after(page, page.apply_settings)
    assert page.frame.answer.converged
    assert problem(page) == ""


@of_bodies(["hexahedra", "2D"])
def test_a_sliding_patch_moves_along_its_normal(page):
    select(page, GRASP)
    page.controls.sliding.value = True
    page.controls.radii[GRASP].value = 0.3
    drag_tip(page, np.array([0.02, 0.01, 0.0]))
    request, grasp = page.frame.request, page.frame.grasp
    assert request.sliding
    assert page._error == ""
    pushed = np.abs(grasp.nodal_force).max(axis=0) > 0
    assert pushed.sum() == 1
    normal = int(pushed.argmax())
    moved = page.frame.displacement[request.nodes, normal] / page.body.scene.length
    assert torch.allclose(moved, request.translation[normal].expand_as(moved), atol=1e-4)
    mask = request.nodes[page.body.surface.nodes]
    assert page._marker.mask.tolist() == mask.tolist(), "the nodes that are pushed are marked"


def test_a_long_solve_is_reported_until_its_frame_is_shown(page, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(type(page.worker), "solving_time", 3.2)
        assert problem(page) == "Solving for 3 s ..."
    assert problem(page) == ""


@of_bodies(["degree 2", "2D", "range of Poisson's ratios"])
def test_sliders_load_the_patch(page):
    page.controls.amplitude.value = 0.5
    after(page, page.apply_controls, BY_USER)
    assert page.frame.request.force.any()
    assert page.frame.answer.amplitude == pytest.approx(0.5, abs=0.5)
    after(page, page.sample)
    assert not page.frame.answer.out_of_distribution
    assert page.frame.request.force[page.node].any(), "the hand moves to a loaded node"
    assert after(page, page.reset).answer.method == "rest"


def test_a_click_moves_the_patch_to_the_nearest_point_on_the_ray(page):
    event = SimpleNamespace(ray_origin=(0.5, -3.0, 0.125), ray_direction=(0.0, 1.0, 0.0))
    asyncio.run(page.click(event))
    assert page.body.scene.problem.points[page.node].tolist() == [0.5, 0.0, 0.125]


def test_the_amplitude_slider_follows_a_drag_and_not_itself(page):
    drag_tip(page, np.array([0.0, 0.0, 0.08]))
    amplitude = page.frame.answer.amplitude
    assert amplitude > 0.01
    assert page.controls.amplitude.value == pytest.approx(amplitude, abs=0.01)
    direction = np.array(page.controls.direction.value)
    assert direction[2] > 0.9 * np.linalg.norm(direction)
    page.controls.amplitude.value = -0.5
    after(page, page.apply_controls, BY_USER)
    assert page.controls.amplitude.value == -0.5


def test_a_body_at_rest_is_neutral_and_has_no_legend(page):
    node = page._body_node
    for quantity in QUANTITIES:
        page.controls.quantity.value = quantity
        after(page, page.apply_settings)
        assert "on the surface" not in page.controls.readings.content
        visible = [band for band in node._meshes[:-1] if band.visible]
        assert [tuple(band.color) for band in visible] == [NEUTRAL]
    drag_tip(page, np.array([0.0, 0.0, 0.08]))
    assert "on the surface" in page.controls.readings.content
    after(page, page.reset)
    assert "on the surface" not in page.controls.readings.content


@of_bodies(["range of Young's moduli"])
def test_the_slider_of_youngs_modulus_has_a_unit_with_prefix(page):
    slider = page.controls.young
    assert (slider.label, slider.min, slider.max, slider.value) == ("E [MPa]", 1.0, 3.0, 2.0)
    assert page.controls.modulus == 2e6
    after(page, page.sample)
    assert page.controls.modulus == pytest.approx(page.frame.request.young)
    page.controls.modulus = 9e9
    assert slider.value == 3.0


@of_bodies(["degree 2", "2D"])
def test_feature_edges_replace_element_edges(page):
    node, surface = page._body_node, page.body.surface
    edges, mesh, undeformed = node._lines
    assert [lines.visible for lines in node._lines] == [True, False, False]
    assert len(edges.points) == len(surface.feature_edges) < len(surface.edges)
    assert node._meshes[-1].visible, "symbols of the supports"
    page.controls.edges.value = True
    drag_tip(page, np.array([0.0, 0.05, 0.0]))
    assert mesh.visible
    assert undeformed.visible
    assert len(mesh.points) == len(surface.edges)


def test_errors_are_shown_at_once_and_escaped(page, monkeypatch):
    monkeypatch.setattr(page.worker, "submit", lambda make: page._show_error("<script>"))
    page.reset(None)
    assert problem(page) == "<script>"
    assert "<script>" not in page.controls.readings.content


def test_the_camera_of_a_browser_is_fitted_to_its_window(page):
    client = SimpleNamespace(camera=SimpleNamespace(aspect=0.6), atomic=contextlib.nullcontext)
    for both in (False, True):
        page.controls.show_newton.value = both
        page._fit_client(client)
        expected = page.placement.camera(aspect=0.6, both=both)
        assert client.camera.position == pytest.approx(expected.position)
        assert client.camera.look_at == pytest.approx(expected.look_at)


def test_dots_lie_above_the_surface(page):
    marker, points = page._marker, page.frame.points
    marker.show(page.frame)
    middle = points.mean(axis=0)
    above = np.linalg.norm(marker._dots.points - middle, axis=1)
    assert len(above) == marker.mask.sum()
    assert (above > np.linalg.norm(points[marker.mask] - middle, axis=1)).all()


def test_predictions_are_corrected_in_the_modes_if_the_model_has_some(page, make_page, tmp_path):
    problem = page.body.scene.problem
    count = int(problem.free.sum())
    vectors = torch.zeros(*problem.shape, count, dtype=torch.float64)
    vectors[problem.free] = torch.eye(count).double()
    newton = SubspaceNewton(problem, vectors)
    simulator = Simulator(page.body.simulator.surrogate, newton=newton)
    other = make_page(Body(simulator), tmp_path)
    try:
        assert after(other, other.sample).answer.method == "corrected"
    finally:
        other.close()


def test_no_part_of_the_path_of_a_recording_comes_from_the_browser(page):
    page._toggle_recording(None)
    after(page, page.reset)
    event = SimpleNamespace(client=None, target=SimpleNamespace(value="x/../../stolen.GIF"))
    with pytest.raises(KeyError):
        page._save(event)
    assert list(page.folder.parent.rglob("*stolen*")) == list(page.folder.rglob("*")) == []


def test_a_frame_that_is_not_finite_is_shown_as_invalid(page, monkeypatch):
    wrong = page.body.simulator.surrogate
    monkeypatch.setattr(wrong, "predict", lambda load: torch.full_like(load.force, torch.nan))
    after(page, page.sample)
    assert "above 100 %" in page.controls.readings.content
    assert "NOT VALID" in page.controls.details.content


@of_bodies(["hexahedra", "2D"])
def test_a_load_rotates_while_a_browser_is_open_until_a_user_changes_it(page, monkeypatch):
    monkeypatch.setattr(page, "_rotating", rotating_load(page.body))
    rest = page.frame
    page.refresh()
    assert page.worker.wait(240)
    assert page.frame is rest, "no browser, no computation"
    monkeypatch.setattr(page.server, "get_clients", lambda: {0: None})
    page.refresh()
    assert page.worker.wait(240)
    assert page.frame.request.force.any()
    drag_tip(page, np.array([0.0, 0.05, 0.0]))
    dragged = page.frame
    page.refresh()
    assert page.worker.wait(240)
    assert page.frame is dragged

"""Pages of all kinds of bodies, without a browser: drags, clicks and controls."""

import asyncio
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="the extra viewer is not installed")

from dpl.fem import SubspaceNewton, rectangle
from dpl.inference import Simulator
from dpl.viewer import AccessPolicy, Body, Page

BODIES = {
    "hexahedra": {},
    "degree 2": {"degree": 2, "cell": "tetra"},
    "2D": {"mesh": rectangle([100.0, 25.0], [9, 4])},
    "range of Poisson's ratios": {"poisson": [0.2, 0.4]},
    "range of Young's moduli": {"young": [1e6, 3e6]},
}


@pytest.fixture(params=BODIES, ids=str)
def any_page(request, make_scene, make_body, tmp_path):
    """A page of each kind of body."""
    body = make_body(make_scene(**BODIES[request.param]))
    page = Page(body, AccessPolicy.bind("127.0.0.1", 0), title="t", folder=tmp_path)
    assert page.worker.wait(240)
    yield page
    page.close()


def drag_tip(page, motion):
    """Send the drag events of a browser that moves the tip by a vector (3,)."""
    place = page.frame.points[page.body.surface.undeformed[:, 0].argmax()]
    for phase, share in (("start", 0.1), ("update", 0.6), ("end", 1.0)):
        event = SimpleNamespace(
            phase=phase, start_position=tuple(place), end_position=tuple(place + share * motion)
        )
        asyncio.run(page.drag(event))
    assert page.worker.wait(240)


def test_a_dragged_point_follows_the_mouse(any_page):
    page = any_page
    flat = page.body.scene.problem.shape[1] == 2
    drag_tip(page, np.array([0.0, 0.08, 0.0] if flat else [0.0, 0.0, 0.08]))
    frame = page.frame
    tip = frame.displacement[page.node] / page.body.scene.length
    assert tip[-1] == pytest.approx(0.08, rel=0.3)
    page.refresh()
    assert "min det F" in page.controls._result.content
    assert "displacement [m]" in page.controls._legend.content
    assert page._error == ""


def test_sliders_load_the_patch(any_page):
    page = any_page
    page.controls.amplitude.value = 0.5
    page.apply_controls(SimpleNamespace(client=object()))
    assert page.worker.wait(240)
    assert page.frame.request.force.any()
    assert page.frame.answer.amplitude == pytest.approx(0.5, abs=0.5)
    page.sample(None)
    assert page.worker.wait(240)
    assert not page.frame.answer.out_of_distribution
    page.reset(None)
    assert page.worker.wait(240)
    assert page.frame.answer.method == "rest"


def test_a_click_moves_the_patch_to_the_nearest_point_on_the_ray(page):
    assert page.worker.wait(240)
    event = SimpleNamespace(ray_origin=(0.5, -3.0, 0.125), ray_direction=(0.0, 1.0, 0.0))
    asyncio.run(page.click(event))
    assert page.body.scene.problem.points[page.node].tolist() == [0.5, 0.0, 0.125]


def test_the_amplitude_slider_follows_a_drag_and_not_itself(page):
    assert page.worker.wait(240)
    drag_tip(page, np.array([0.0, 0.0, 0.08]))
    page.refresh()
    amplitude = page.frame.answer.amplitude
    assert amplitude > 0.01
    assert page.controls.amplitude.value == pytest.approx(amplitude, abs=0.01)
    direction = np.array(page.controls.direction.value)
    assert direction[2] > 0.9 * np.linalg.norm(direction)
    page.controls.amplitude.value = -0.5
    page.apply_controls(SimpleNamespace(client=object()))
    assert page.worker.wait(240)
    page.refresh()
    assert page.controls.amplitude.value == -0.5


def test_the_legend_of_an_undeformed_body_has_no_numbers_on_its_scale(page):
    assert page.worker.wait(240)
    page.refresh()
    legend = page.controls._legend.content
    assert "0 m everywhere" in legend
    assert "<span>0</span>" not in legend


def test_dots_lie_above_the_surface(page):
    assert page.worker.wait(240)
    marker, points = page._marker, page.frame.points
    middle = points.mean(axis=0)
    above = np.linalg.norm(marker._dot_positions(points) - middle, axis=1)
    assert len(above) == marker.mask.sum()
    assert (above > np.linalg.norm(points[marker.mask] - middle, axis=1)).all()


def test_the_galerkin_correction_is_offered_if_the_simulator_has_one(page, body, tmp_path):
    assert page.worker.wait(240)
    assert not page.controls.galerkin.visible
    assert not page.controls.settings().galerkin
    problem = body.scene.problem
    count = int(problem.free.sum())
    vectors = torch.zeros(*problem.shape, count, dtype=torch.float64)
    vectors[problem.free] = torch.eye(count).double()
    newton = SubspaceNewton(problem, vectors)
    simulator = Simulator(body.simulator.surrogate, newton=newton)
    policy = AccessPolicy.bind("127.0.0.1", 0)
    other = Page(Body(simulator), policy, title="t", folder=tmp_path)
    try:
        assert other.controls.galerkin.visible
        other.controls.method.value = "residual below 1e-03"
        other.apply_settings(None)
        other.sample(None)
        assert other.worker.wait(240)
        assert other.frame.answer.method == "corrected"
        other.controls.galerkin.value = False
        other.apply_settings(None)
        assert other.worker.wait(240)
        assert other.frame.answer.method == "hybrid"
    finally:
        other.close()


def test_no_part_of_the_path_of_a_recording_comes_from_the_browser(page, tmp_path):
    assert page.worker.wait(240)
    page._toggle_recording(None)
    page.reset(None)
    assert page.worker.wait(240)
    event = SimpleNamespace(client=None, target=SimpleNamespace(value="x/../../stolen.GIF"))
    with pytest.raises(KeyError):
        page._save(event)
    assert list(tmp_path.rglob("*.gif")) == []


def test_error_messages_are_escaped(page):
    assert page.worker.wait(240)
    page._show_error("<script>")
    page.refresh()
    assert "&lt;script&gt;" in page.controls._error.content


def test_a_frame_that_is_not_finite_is_shown_as_invalid(page):
    assert page.worker.wait(240)
    surrogate = page.body.simulator.surrogate
    good = surrogate.predict
    try:
        surrogate.predict = lambda load: torch.full_like(load.force, torch.nan)
        page.sample(None)
        assert page.worker.wait(240)
        page.refresh()
        assert "NOT VALID" in page.controls._result.content
    finally:
        surrogate.predict = good

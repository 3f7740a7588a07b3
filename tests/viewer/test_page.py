"""Laws of the page without a browser: bodies of all kinds, and what a hand does to them."""

import asyncio
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="the extra viewer is not installed")

from dpl.fem import rectangle
from dpl.viewer import AccessPolicy, Page

BODIES = {
    "hexahedra": {},
    "degree 2": {"degree": 2, "cell": "tetra"},
    "in the plane": {"mesh": rectangle([100.0, 25.0], [9, 4])},
    "range of Poisson's ratios": {"poisson": [0.2, 0.4]},
    "range of Young's moduli": {"young": [1e6, 3e6]},
}


@pytest.fixture(params=BODIES, ids=str)
def any_page(request, make_scene, make_body, tmp_path):
    """A page of each kind of body."""
    body = make_body(make_scene(**BODIES[request.param]))
    page = Page(body, AccessPolicy.bound("127.0.0.1", 0), title="t", folder=tmp_path)
    assert page.worker.settle(240)
    yield page
    page.close()


def drag(page, way):
    """Drag the tip by a vector (3,), as the browser tells it."""
    place = page._frame.points[page.body.surface.rest[:, 0].argmax()]
    for phase, share in (("start", 0.1), ("update", 0.6), ("end", 1.0)):
        event = SimpleNamespace(
            phase=phase, start_position=tuple(place), end_position=tuple(place + share * way)
        )
        asyncio.run(page._dragged(event))
    assert page.worker.settle(240)


def test_a_drag_moves_the_body_with_the_hand(any_page):
    page = any_page
    flat = page.body.scene.problem.shape[1] == 2
    drag(page, np.array([0.0, 0.08, 0.0] if flat else [0.0, 0.0, 0.08]))
    frame = page._frame
    tip = frame.displacement[page._node] / page.body.scene.length
    assert tip[-1] == pytest.approx(0.08, rel=0.3)
    page.refresh()
    assert "min det F" in page._reading.content
    assert "displacement [m]" in page._colours.content
    assert page._said == ""


def test_controls_load_the_patch(any_page):
    page = any_page
    page._amplitude.value = 0.5
    page._controlled(SimpleNamespace(client=object()))
    assert page.worker.settle(240)
    assert page._frame.asked.force.any()
    assert page._frame.answer.amplitude == pytest.approx(0.5, abs=0.5)
    page._sampled(None)
    assert page.worker.settle(240)
    assert not page._frame.answer.out_of_distribution
    page._reset(None)
    assert page.worker.settle(240)
    assert page._frame.answer.method == "rest"


def test_a_click_places_the_patch_on_the_near_side(page):
    assert page.worker.settle(240)
    event = SimpleNamespace(ray_origin=(0.5, -3.0, 0.125), ray_direction=(0.0, 1.0, 0.0))
    asyncio.run(page._clicked(event))
    assert page.body.scene.problem.points[page._node].tolist() == [0.5, 0.0, 0.125]


def test_trouble_is_read_and_nothing_of_it_is_markup(page):
    assert page.worker.settle(240)
    page._trouble("<script>")
    page.refresh()
    assert "&lt;script&gt;" in page._told.content


def test_a_frame_that_is_not_finite_is_said_to_be_invalid(page):
    assert page.worker.settle(240)
    surrogate = page.body.simulator.surrogate
    good = surrogate.predict
    try:
        surrogate.predict = lambda load: torch.full_like(load.force, torch.nan)
        page._sampled(None)
        assert page.worker.settle(240)
        page.refresh()
        assert "NOT VALID" in page._reading.content
    finally:
        surrogate.predict = good

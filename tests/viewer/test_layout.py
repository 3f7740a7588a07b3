"""Cameras, places of the bodies, arrows of loads and symbols of supports."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dpl.fem import rectangle
from dpl.viewer.camera import Camera, Placement, largest_loads
from dpl.viewer.frames import ViewSettings
from dpl.viewer.surface import Surface, exit_distance

RADIUS = 0.4
PLATE = rectangle([100.0, 25.0], [9, 4])


def tip(body):
    return int(body.surface.nodes[body.surface.undeformed[:, 0].argmax()])


@pytest.fixture(scope="module", params=["3D", "2D"])
def placed(request, body, make_scene, make_body):
    """The tiny beam or a plate, its places, and its shapes at rest and under the largest loads."""
    body = body if request.param == "3D" else make_body(make_scene(mesh=PLATE))
    frames = largest_loads(body, tip(body), RADIUS)
    shapes = [body.surface.undeformed, *(frame.points for frame in frames)]
    return body, Placement.of(body, tip(body), RADIUS), shapes


def box_in_image(camera, points, aspect):
    """Return the smallest and largest column and row of points, over the size of the image."""
    pixels = camera.project(points, 1000, round(1000 / aspect))
    assert pixels[:, 2].min() > 0
    shares = pixels[:, :2] / (1000, round(1000 / aspect))
    return shares.min(axis=0), shares.max(axis=0)


@pytest.mark.parametrize("aspect", [0.5, 1.25, 2.5])
@pytest.mark.parametrize("planar", [False, True])
def test_a_fitted_camera_shows_all_points_and_is_as_near_as_possible(aspect, planar):
    points = np.random.default_rng(0).random((50, 3)) * (1.0, 0.3, 0.0 if planar else 0.5)
    margins = (0.02, 0.12, 0.04, 0.2)
    camera = Camera.fit(points, planar=planar, aspect=aspect, margins=margins)
    low, high = box_in_image(camera, points, aspect)
    empty = np.array([low[0], 1 - high[0], 1 - high[1], low[1]]) - margins
    assert empty.min() >= -1e-3
    pairs = empty.reshape(2, 2)
    assert np.abs(pairs).max(axis=1).min() < 1e-3, "one direction has no further space"


@pytest.mark.parametrize("both", [False, True])
def test_the_camera_shows_rest_and_largest_loads_of_one_or_two_bodies(placed, both):
    body, placement, shapes = placed
    dim = body.scene.problem.shape[1]
    assert len(shapes) == 1 + 2 * dim + 2**dim
    assert max(np.abs(shape - shapes[0]).max() for shape in shapes) > 0.1, "loads are large"
    points = np.concatenate(shapes)
    for aspect in (0.7, 1.2, 2.0):
        camera = placement.camera(aspect=aspect, both=both)
        for offset in [np.zeros(3), placement.offset] if both else [np.zeros(3)]:
            low, high = box_in_image(camera, points + offset, aspect)
            assert low.min() > 0
            assert high.max() < 1


def test_two_bodies_do_not_overlap_in_the_image(placed):
    _, placement, shapes = placed
    camera = placement.camera(both=True)
    for shape in shapes:
        first = box_in_image(camera, shape, 1.2)
        label = camera.project(placement.label, 1000, 833)[1] / 833
        assert label < first[0][1], "the label lies above the body"
        second = box_in_image(camera, shape + placement.offset, 1.2)
        gaps = np.maximum(second[0] - first[1], first[0] - second[1])
        assert gaps.max() > 0


def test_the_camera_also_shows_what_lies_beyond_the_largest_loads(placed):
    _, placement, shapes = placed
    far = shapes[0] + np.array([1.5, 0.0, 0.0])
    low, high = box_in_image(placement.camera(shown=far), far, 1.2)
    assert low.min() > 0
    assert high.max() < 1


def test_predictions_that_are_not_finite_do_not_move_the_camera(body, monkeypatch):
    wrong = body.simulator.surrogate
    monkeypatch.setattr(wrong, "predict", lambda load: torch.full_like(load.force, torch.nan))
    placement = Placement.of(body, tip(body), RADIUS)
    assert np.isfinite(placement.points).all()
    assert np.isfinite(placement.camera().position).all()


def test_an_arrow_starts_on_the_surface_and_points_along_the_force(body):
    patch = body.patch(tip(body), RADIUS)
    direction = torch.tensor([0.0, 0.0, 1.0]).double()
    frame = body.solve(body.request(patch.force_along(direction, 1.0)), ViewSettings(tol=1e-6))
    start, end = body.arrow_ends(frame)
    total = frame.request.force.sum(dim=0).numpy()
    cosine = (end - start) @ total / np.linalg.norm(end - start) / np.linalg.norm(total)
    assert cosine == pytest.approx(1)
    ahead = (frame.points - end) @ total / np.linalg.norm(total)
    assert ahead.max() < 0.1, "the tip of the arrow is outside"
    small = body.solve(body.request(patch.force_along(direction, 0.1)), ViewSettings(tol=1e-6))
    shorter = np.diff(body.arrow_ends(small), axis=0)
    assert np.linalg.norm(shorter) < np.linalg.norm(end - start)


def test_there_is_no_arrow_without_a_total_force(body):
    assert not len(body.arrow_ends(body.solve(body.zero_load(), ViewSettings())))
    frame = body.solve(body.zero_load(), ViewSettings())
    force = torch.zeros_like(frame.request.force)
    force[-1, 2], force[-2, 2] = 1.0, -1.0
    balanced = frame._replace(request=replace(frame.request, force=force))
    assert not len(body.arrow_ends(balanced))


def test_a_ray_leaves_a_box_at_its_side(body):
    surface = body.surface
    for direction, distance in (
        ((1.0, 0, 0), 0.7),
        ((-1.0, 0, 0), 0.3),
        ((0, 0.6, 0.8), 0.15 / 0.8),
    ):
        found = exit_distance(
            surface.undeformed, surface.triangles, np.array([0.3, 0.1, 0.1]), np.array(direction)
        )
        assert found == pytest.approx(distance)


@pytest.mark.parametrize(
    "more", [{"degree": 2, "cell": "tetra"}, {"mesh": PLATE}], ids=["3D", "2D"]
)
def test_symbols_of_supports_surround_the_fixed_nodes_and_move_with_them(make_scene, more):
    problem = make_scene(**more).problem
    surface = Surface.of(problem)
    fixed = surface.undeformed[~problem.free.numpy()[surface.nodes].all(axis=1)]
    centres = surface.supports(surface.undeformed).reshape(-1, 24, 3).mean(axis=1)
    assert centres == pytest.approx(fixed)
    assert not fixed[:, 0].any(), "the clamped end"
    moved = surface.supports(surface.undeformed + 0.1).reshape(-1, 24, 3).mean(axis=1)
    assert moved == pytest.approx(fixed + 0.1)
    free = torch.ones_like(problem.free)
    assert not len(Surface.of(replace(problem, free=free)).supports(surface.undeformed))

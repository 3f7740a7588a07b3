"""Cameras, places of the bodies, arrows of loads and symbols of supports."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dpl.fem import rectangle
from dpl.viewer.camera import Camera, Placement, label_position, largest_loads
from dpl.viewer.frames import ViewSettings, arrow_ends
from dpl.viewer.surface import THICKNESS, Surface, exit_distance

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


def test_a_label_lies_above_all_that_is_shown(body):
    rest = body.surface.undeformed
    shown = rest + np.array([0.0, 0.0, 0.3])
    camera = Camera.fit(np.concatenate([rest, shown]))
    label = label_position(shown, rest, planar=False)
    rows = camera.project(np.concatenate([shown, label[None]]), 1000, 1000)[:, 1]
    assert rows[-1] < rows[:-1].min()


def test_an_arrow_starts_on_the_surface_and_points_along_the_force(body):
    patch = body.patch(tip(body), RADIUS)
    direction = torch.tensor([0.0, 0.0, 1.0]).double()
    frame = body.solve(body.request(patch.force_along(direction, 1.0)), ViewSettings(tol=1e-6))
    start, end = arrow_ends(body.surface, frame)
    total = frame.request.force.sum(dim=0).numpy()
    cosine = (end - start) @ total / np.linalg.norm(end - start) / np.linalg.norm(total)
    assert cosine == pytest.approx(1)
    ahead = (frame.points - end) @ total / np.linalg.norm(total)
    assert ahead.max() < 0.1, "the tip of the arrow is outside"
    small = body.solve(body.request(patch.force_along(direction, 0.1)), ViewSettings(tol=1e-6))
    shorter = np.diff(arrow_ends(body.surface, small), axis=0)
    assert np.linalg.norm(shorter) < np.linalg.norm(end - start)


def test_there_is_no_arrow_without_a_total_force(body):
    assert not len(arrow_ends(body.surface, body.solve(body.zero_load(), ViewSettings())))
    frame = body.solve(body.zero_load(), ViewSettings())
    force = torch.zeros_like(frame.request.force)
    force[-1, 2], force[-2, 2] = 1.0, -1.0
    balanced = frame._replace(load=frame.load._replace(force=force))
    assert not len(arrow_ends(body.surface, balanced))


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
    "more", [{}, {"cell": "tetra"}, {"degree": 2, "cell": "tetra"}], ids=["hexa", "tetra", "P2"]
)
def test_supports_are_a_slab_behind_the_fixed_face(make_scene, more):
    surface = Surface.of(make_scene(**more).problem)
    symbols = surface.supports
    assert not symbols.moves
    vertices = symbols.vertices(surface.undeformed)
    assert set(vertices[:, 0].round(9)) == {0.0, -THICKNESS}
    assert vertices[:, 1:].min() == pytest.approx(0)
    assert vertices[:, 1:].max() == pytest.approx(0.25)
    a, b, c = (vertices[symbols.triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(0.25**2 + 4 * 0.25 * THICKNESS), "a face and four walls"


def test_supports_in_the_plane_are_a_strip_outside_of_the_body(make_scene):
    surface = Surface.of(make_scene(mesh=PLATE).problem)
    symbols = surface.supports
    vertices = symbols.vertices(surface.undeformed)
    assert vertices[:, 0].min() == pytest.approx(-THICKNESS)
    assert vertices[:, 0].max() == pytest.approx(0)
    a, b, c = (vertices[symbols.triangles[:, k]] for k in range(3))
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(
        0.25 * THICKNESS
    )


def test_a_single_fixed_node_has_a_pyramid_with_its_tip_at_the_node(make_scene):
    problem = make_scene().problem
    corner = int(problem.points.sum(dim=1).argmax())
    free = problem.free.clone()
    free[:] = True
    free[corner, 2] = False
    surface = Surface.of(replace(problem, free=free))
    symbols = surface.supports
    assert symbols.moves, "the node slides in two directions"
    vertices = symbols.vertices(surface.undeformed)
    assert len(vertices) == 5
    assert vertices[0] == pytest.approx(problem.points[corner].numpy())
    assert (np.linalg.norm(vertices[1:] - vertices[0], axis=1) > 0.02).all()
    assert (vertices[1:].mean(axis=0) > vertices[0]).all(), "outside of the body"
    shift = np.array([0.0, 0.1, 0.0])
    assert symbols.vertices(surface.undeformed + shift) == pytest.approx(vertices + shift)

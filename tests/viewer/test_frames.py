"""Surfaces, patch loads and frames of the viewer."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from dpl.fem import fields, rectangle
from dpl.viewer import Body
from dpl.viewer.controls import round_step
from dpl.viewer.frames import ERROR, STRESS, ViewSettings
from dpl.viewer.renderer import colour_top, engineering
from dpl.viewer.surface import Surface, contour_bands


def volume(points, triangles):
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


def areas(soup):
    corners = soup.reshape(-1, 3, 3)
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


@pytest.fixture
def patch_load(body, tip):
    """A load on the tip."""
    target = torch.tensor([0.0, 0.0, 0.2]).double()
    return body.request(body.patch(tip, 0.4).force_towards(target))


@pytest.mark.parametrize(
    "more",
    [{}, {"cell": "tetra"}, {"degree": 2}, {"degree": 2, "cell": "tetra"}],
    ids=["hexahedra", "tetrahedra", "degree 2", "degree 2, tetrahedra"],
)
def test_a_surface_is_closed_and_has_outward_normals(make_scene, more):
    surface = Surface.of(make_scene(**more).problem)
    assert volume(surface.undeformed, surface.triangles) == pytest.approx(0.25 * 0.25)
    sides = np.sort(surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(sides, axis=0, return_counts=True)[1] == 2).all()
    rims = np.linalg.norm(np.diff(surface.undeformed[surface.feature_edges], axis=1), axis=2).sum()
    assert rims == pytest.approx(4 * (1 + 0.25 + 0.25)), "the twelve edges of a beam"


def test_a_surface_in_the_plane_is_the_body(make_scene):
    mesh = rectangle([100.0, 25.0], [9, 4])
    surface = Surface.of(make_scene(mesh=mesh).problem)
    assert surface.undeformed.shape == (36, 3)
    corners = surface.undeformed[surface.triangles]
    assert areas(corners)[:, 2].min() > 0
    assert areas(corners).sum(axis=0) == pytest.approx([0, 0, 0.25])


@pytest.mark.parametrize("seed", range(3))
def test_bands_cover_the_surface(body, seed):
    surface, random = body.surface, np.random.default_rng(seed)
    levels = random.integers(0, 6, len(surface.undeformed)) * 1.0  # many ties, at and between edges
    levels += random.random(len(levels)) * (seed > 0)
    cut = contour_bands(surface.undeformed, surface.triangles, levels, 7)
    whole = areas(surface.undeformed[surface.triangles])
    pieces = np.concatenate([areas(soup) for soup in cut])
    assert np.linalg.norm(pieces, axis=1).sum() == pytest.approx(
        np.linalg.norm(whole, axis=1).sum()
    )
    total = np.concatenate(cut)
    assert volume(total, np.arange(len(total)).reshape(-1, 3)) == pytest.approx(1 / 16)


def test_bands_of_constant_and_linear_fields(body):
    points, triangles = body.surface.undeformed, body.surface.triangles
    cut = contour_bands(points, triangles, np.full(len(points), 2.5), 4)
    assert [len(soup) for soup in cut] == [0, 0, 3 * len(triangles), 0]
    for k, soup in enumerate(contour_bands(points, triangles, 5 * points[:, 0], 5)):
        assert soup[:, 0].min() == pytest.approx(k / 5), "straight boundaries"
        assert soup[:, 0].max() == pytest.approx((k + 1) / 5)


def test_stress_at_the_surface_is_that_of_the_whole_body(body, make_scene):
    for scene in (body.scene, make_scene(cell="tetra", degree=2)):
        surface = Surface.of(scene.problem)
        load = scene.loads.sample((0, 4), [1])
        u = scene.linear.solve(load.force[0])
        exact = fields(scene.problem, u[None]).von_mises[0].numpy()[surface.nodes]
        assert surface.von_mises(u, load.parameters) == pytest.approx(exact, rel=1e-12)


def test_the_dragged_point_moves_to_the_target(body, patch_load, tip):
    frame = body.solve(patch_load, ViewSettings(tol=1e-8))
    moved = frame.displacement[tip] / body.scene.length
    assert moved[2] == pytest.approx(0.2, rel=0.25), "up to the nonlinearity of the body"
    assert abs(moved[1]) < 0.02
    assert not frame.answer.out_of_distribution
    force = body.patch(tip, 0.4).force_towards(torch.tensor([0.0, 0.0, 50.0]).double())
    assert float(body.scene.loads.project(force[None])[0]) == pytest.approx(1.0), "in the range"


def test_the_amplitude_of_a_patch_load_is_that_of_the_training(body):
    for node in map(int, body.surface.nodes[::7]):
        if not body.scene.problem.free[node].any():
            continue
        force = body.patch(node, 0.4).force_along(torch.tensor([0.0, 1.0, 1.0]).double(), 0.7)
        amplitude, out_of_span = body.scene.loads.project(force[None])
        assert float(amplitude) <= 0.7 + 1e-6
        assert float(out_of_span) < 1e-9
    still = body.patch(node, 0.4).force_along(torch.zeros(3).double(), 0.7)
    assert not still.any()


def test_values_are_those_of_the_quantity(body, patch_load):
    surface = body.surface
    frame = body.solve(patch_load, ViewSettings())
    moved = frame.displacement.norm(dim=1).numpy()[surface.nodes]
    assert frame.values == pytest.approx(moved)
    assert frame.points == pytest.approx(
        surface.deformed_points(frame.displacement / body.scene.length)
    )
    settings = ViewSettings(quantity=STRESS)
    assert body.solve(patch_load, settings).values.max() > 0
    assert not body.solve(body.zero_load(), settings).values.any(), "exactly zero at rest"
    error = body.solve(patch_load, ViewSettings(quantity=ERROR)).values
    assert error.max() == pytest.approx(0.02 / 0.98 * moved.max(), rel=1e-4)
    exact = body.solve(patch_load, ViewSettings(quantity=ERROR, tol=1e-8)).values
    assert exact.max() < 1e-6 * moved.max()


def test_displacements_and_stresses_scale_with_young(body, patch_load):
    settings = ViewSettings(quantity=STRESS, tol=1e-8)
    stiff = body.solve(replace(patch_load, young=2 * patch_load.young), settings)
    soft = body.solve(patch_load, settings)
    assert stiff.displacement.norm() < 0.7 * soft.displacement.norm()
    bigger = replace(patch_load, force=3 * patch_load.force, young=3 * patch_load.young)
    bigger = body.solve(bigger, settings)
    assert bigger.values == pytest.approx(3 * soft.values, rel=1e-5)


def test_newton_frames_start_undeformed_and_converge(body, patch_load):
    settings = ViewSettings(quantity=ERROR)
    frame = body.solve(patch_load, settings)
    iterates = list(body.newton_frames(patch_load, settings, frame))
    assert iterates[0].points == pytest.approx(body.surface.undeformed)
    counts = [int(state.answer.iterations) for state in iterates]
    assert counts == sorted(counts)
    assert iterates[-1].answer.converged
    assert iterates[-1].answer.residual < 1e-8
    assert iterates[-1].values.max() == pytest.approx(frame.values.max(), rel=1e-4)


def test_ranges_of_moduli_are_those_of_the_scene(make_scene, make_body):
    body = make_body(make_scene(young=[1e6, 3e6]))
    assert body.young_range == (1e6, 3e6)
    assert body.young == 2e6
    assert body.parameters == {}
    assert 1e6 <= body.sample(1).young <= 3e6
    decades = {"low": 1e6, "high": 1e10, "distribution": "log"}
    assert make_body(make_scene(young=decades)).young == pytest.approx(1e8), "in the middle"


def test_poissons_ratio_changes_the_solution(make_scene, make_body, tip):
    scene = make_scene(poisson=[0.2, 0.4])
    body: Body = make_body(scene)
    force = body.patch(tip, 0.4).force_towards(torch.tensor([0.0, 0.0, 0.1]).double())

    def with_ratio(nu):
        return replace(body.request(force), parameters={"poisson": nu})

    settings = ViewSettings(quantity=STRESS, tol=1e-8)
    values = [body.solve(with_ratio(nu), settings).values.max() for nu in (0.2, 0.4)]
    assert values[0] != pytest.approx(values[1], rel=1e-3)
    request = with_ratio(0.25)
    *_, last = body.newton_frames(request, ViewSettings(), body.solve(request, ViewSettings()))
    assert last.answer.converged


def test_the_colour_scale_has_rounded_ends_and_ignores_small_changes():
    ends = [colour_top(np.array([x])) for x in (0.0, 1.0, 1.2, 7.0, 9.0, 480.0)]
    assert ends == [0, 1, 1.5, 8, 10, 500]
    top, tops = 0.0, []
    for largest in (4.1, 4.9, 5.2, 4.1, 1.0):
        top = colour_top(np.array([0.0, largest]), top)
        tops.append(top)
    assert tops == [5, 5, 6, 6, 1]
    assert colour_top(np.array([np.nan, np.inf]), top) == 0


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        *((0.0, "N", "0 N"), (9583.0, "N", "9.58 kN"), (0.0034, "m", "3.4 mm")),
        *((24.2, "m", "24.2 m"), (999.6, "Pa", "1 kPa"), (123_456.0, "Pa", "123 kPa")),
        *((2.03e11, "Pa", "203 GPa"), (-1250.0, "N/m", "-1.25 kN/m"), (5e-6, "m", "5 µm")),
        (math.nan, "N", "nan N"),
    ],
)
def test_values_have_three_digits_and_a_prefix(value, unit, text):
    assert engineering(value, unit) == text


@pytest.mark.parametrize("span", [(1125.0, 18000.0), (0.25, 4.0), (1.0, 203.0), (1.0, 1.001)])
def test_values_of_a_slider_have_at_most_five_digits(span):
    step = round_step(*span)
    assert step == pytest.approx(10.0 ** round(math.log10(step)))
    assert len(f"{round(span[1] / step):d}") <= 5

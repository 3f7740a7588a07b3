"""Laws of the viewer's mechanics: surfaces, loads of a hand, answers as they are shown."""

import numpy as np
import pytest
import torch

from dpl.fem import NeoHookeanLn, fields, rectangle
from dpl.viewer import Body
from dpl.viewer.frames import Scale, ViewSettings, between, round_up
from dpl.viewer.surface import Surface, bands

STRESS, ERROR = "von Mises stress", "error against FE"


def volume(points, triangles):
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


def areas(soup):
    corners = soup.reshape(-1, 3, 3)
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


@pytest.fixture
def pushed(body):
    """A load on the tip and its frame."""
    node = int(body.surface.nodes[body.surface.rest[:, 0].argmax()])
    target = torch.tensor([0.0, 0.0, 0.2]).double()
    return node, body.asked(body.patch(node, 0.4).towards(target), None)


@pytest.mark.parametrize(
    "more",
    [{}, {"cell": "tetra"}, {"degree": 2}, {"degree": 2, "cell": "tetra"}],
    ids=["hexahedra", "tetrahedra", "degree 2", "degree 2, tetrahedra"],
)
def test_a_surface_is_closed_and_looks_outward(make_scene, more):
    surface = Surface.of(make_scene(**more).problem)
    assert volume(surface.rest, surface.triangles) == pytest.approx(0.25 * 0.25)
    sides = np.sort(surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(sides, axis=0, return_counts=True)[1] == 2).all()
    rims = np.linalg.norm(np.diff(surface.rest[surface.rims], axis=1), axis=2).sum()
    assert rims == pytest.approx(4 * (1 + 0.25 + 0.25)), "the twelve edges of a beam"


def test_a_surface_in_the_plane_is_the_body(make_scene):
    mesh = rectangle([100.0, 25.0], [9, 4])
    surface = Surface.of(make_scene(mesh=mesh).problem)
    assert surface.rest.shape == (36, 3)
    corners = surface.rest[surface.triangles]
    assert areas(corners)[:, 2].min() > 0
    assert areas(corners).sum(axis=0) == pytest.approx([0, 0, 0.25])


@pytest.mark.parametrize("seed", range(3))
def test_bands_are_the_whole_surface_and_hold_their_values(body, seed):
    surface, random = body.surface, np.random.default_rng(seed)
    levels = random.integers(0, 6, len(surface.rest)) * 1.0  # many ties, at and between edges
    levels += random.random(len(levels)) * (seed > 0)
    cut = bands(surface.rest, surface.triangles, levels, 7)
    whole = areas(surface.rest[surface.triangles])
    pieces = np.concatenate([areas(soup) for soup in cut])
    assert np.linalg.norm(pieces, axis=1).sum() == pytest.approx(
        np.linalg.norm(whole, axis=1).sum()
    )
    total = np.concatenate(cut)
    assert volume(total, np.arange(len(total)).reshape(-1, 3)) == pytest.approx(1 / 16)


def test_bands_of_one_colour_are_the_surface(body):
    surface = body.surface
    cut = bands(surface.rest, surface.triangles, np.full(len(surface.rest), 2.5), 4)
    assert [len(soup) for soup in cut] == [0, 0, 3 * len(surface.triangles), 0]


def test_bands_of_a_plane_field_are_cut_straight(body):
    surface = body.surface
    levels = 5 * surface.rest[:, 0]
    for k, soup in enumerate(bands(surface.rest, surface.triangles, levels, 5)):
        assert soup[:, 0].min() == pytest.approx(k / 5)
        assert soup[:, 0].max() == pytest.approx((k + 1) / 5)


def test_stress_at_the_surface_is_that_of_the_whole_body(body, make_scene):
    for scene in (body.scene, make_scene(cell="tetra", degree=2)):
        surface = Surface.of(scene.problem)
        load = scene.loads.sample((0, 4), [1])
        u = scene.linear.solve(load.force[0])
        exact = fields(scene.problem, u[None]).von_mises[0].numpy()[surface.nodes]
        assert surface.von_mises(u, load.poisson) == pytest.approx(exact, rel=1e-12)


def test_a_pulled_point_goes_where_the_hand_is(body, pushed):
    node, asked = pushed
    frame = body.answer(asked, ViewSettings(tol=1e-8))
    moved = frame.displacement[node] / body.scene.length
    assert moved[2] == pytest.approx(0.2, rel=0.25), "but for the body's nonlinearity"
    assert abs(moved[1]) < 0.02
    assert not frame.answer.out_of_distribution


def test_a_pull_is_held_within_the_training(body, pushed):
    node, _ = pushed
    far = torch.tensor([0.0, 0.0, 50.0]).double()
    amplitudes = [
        float(body.scene.loads.project(body.patch(node, 0.4).towards(far, most=most)[None])[0])
        for most in (1.0, None)
    ]
    assert amplitudes[0] <= 1 + 1e-9
    assert amplitudes[1] > 10


def test_the_controls_amplitude_is_that_of_the_training(body):
    for node in map(int, body.surface.nodes[::7]):
        if not body.scene.problem.free[node].any():
            continue
        force = body.patch(node, 0.4).along(torch.tensor([0.0, 1.0, 1.0]).double(), 0.7)
        amplitude, strange = body.scene.loads.project(force[None])
        assert float(amplitude) <= 0.7 + 1e-6
        assert float(strange) < 1e-9
    still = body.patch(node, 0.4).along(torch.zeros(3).double(), 0.7)
    assert not still.any()


def test_an_even_force_is_said_to_be_unlike_the_training(body, pushed):
    node, _ = pushed
    patch = body.patch(node, 0.4, uniform=True)
    force = patch.along(torch.tensor([0.0, 0.0, 1.0]).double(), 0.5)
    acting = force[patch.inside & body.scene.loads.loadable_dofs.any(dim=1)]
    assert torch.allclose(acting, acting[:1].expand_as(acting))
    assert body.answer(body.asked(force, None), ViewSettings()).answer.out_of_distribution


def test_colours_are_what_they_are_called(body, pushed):
    _, asked = pushed
    surface = body.surface
    frame = body.answer(asked, ViewSettings())
    moved = frame.displacement.norm(dim=1).numpy()[surface.nodes]
    assert frame.values == pytest.approx(moved)
    assert frame.points == pytest.approx(surface.moved(frame.displacement / body.scene.length))
    stress = body.answer(asked, ViewSettings(quantity=STRESS)).values
    assert stress.max() > 0
    error = body.answer(asked, ViewSettings(quantity=ERROR)).values
    assert error.max() == pytest.approx(0.02 / 0.98 * moved.max(), rel=1e-4)
    exact = body.answer(asked, ViewSettings(quantity=ERROR, tol=1e-8)).values
    assert exact.max() < 1e-6 * moved.max()


def test_a_softer_body_is_moved_further_and_stress_is_in_pascals(body, pushed):
    _, asked = pushed
    wish = ViewSettings(quantity=STRESS, tol=1e-8)
    stiff = body.answer(asked._replace(young=2 * asked.young), wish)
    soft = body.answer(asked, wish)
    assert stiff.displacement.norm() < 0.7 * soft.displacement.norm()
    bigger = body.answer(asked._replace(force=3 * asked.force, young=3 * asked.young), wish)
    assert bigger.values == pytest.approx(3 * soft.values, rel=1e-5)


def test_newtons_iterates_begin_at_rest_and_end_in_balance(body, pushed):
    _, asked = pushed
    wish = ViewSettings(quantity=ERROR)
    frame = body.answer(asked, wish)
    iterates = list(body.newton(asked, wish, frame))
    assert iterates[0].points == pytest.approx(body.surface.rest)
    assert [state.iteration for state in iterates] == sorted(state.iteration for state in iterates)
    assert iterates[-1].converged
    assert iterates[-1].residual < 1e-8
    assert iterates[-1].values.max() == pytest.approx(frame.values.max(), rel=1e-4)


def test_random_loads_are_the_trainings(body):
    for index in range(4):
        answer = body.answer(body.sample(index), ViewSettings()).answer
        assert not answer.out_of_distribution
    assert not torch.equal(body.sample(0).force, body.sample(1).force)


def test_what_cannot_be_asked_is_refused_in_words(body):
    with pytest.raises(ValueError, match="E = 1 Pa must lie between"):
        body.rest(young=1.0)
    with pytest.raises(ValueError, match="quantity = 'heat'"):
        ViewSettings(quantity="heat")
    with pytest.raises(ValueError, match="tol = nan"):
        ViewSettings(tol=float("nan"))
    with pytest.raises(ValueError, match="node = -1"):
        body.patch(-1, 0.4)
    with pytest.raises(ValueError, match="radius = nan"):
        body.patch(0, float("nan"))


def test_ranges_of_moduli_are_those_of_the_scene(make_scene, make_body):
    body = make_body(make_scene(young=[1e6, 3e6]))
    assert body.young_span == (1e6, 3e6)
    assert body.young == 2e6
    assert body.poisson is None
    assert 1e6 <= body.sample(1).young <= 3e6


def test_a_range_of_poissons_ratios_is_asked_for(make_scene, make_body):
    scene = make_scene(poisson=[0.2, 0.4])
    body: Body = make_body(scene)
    node = int(body.surface.nodes[body.surface.rest[:, 0].argmax()])
    force = body.patch(node, 0.4).towards(torch.tensor([0.0, 0.0, 0.1]).double())
    values = [
        body.answer(
            body.asked(force, None, nu), ViewSettings(quantity=STRESS, tol=1e-8)
        ).values.max()
        for nu in (0.2, 0.4)
    ]
    assert values[0] != pytest.approx(values[1], rel=1e-3)
    with pytest.raises(ValueError, match=r"Poisson's ratio 0.45 must lie in"):
        body.asked(force, None, 0.45)
    asked = body.asked(force, None, 0.25)
    assert list(body.newton(asked, ViewSettings(), body.answer(asked, ViewSettings())))[
        -1
    ].converged


def test_a_body_in_the_plane_is_answered_and_shown(make_scene, make_body):
    mesh = rectangle([100.0, 25.0], [9, 4])
    body = make_body(make_scene(mesh=mesh, law=NeoHookeanLn))
    node = int(body.surface.nodes[body.surface.rest[:, 0].argmax()])
    force = body.patch(node, 0.4).towards(torch.tensor([0.0, 0.1]).double())
    frame = body.answer(body.asked(force, None), ViewSettings(quantity=STRESS, tol=1e-6))
    assert frame.points.shape == (36, 3)
    assert not frame.points[:, 2].any()
    assert frame.values.shape == (36,)


def test_the_way_between_loads_begins_and_ends_at_them(body):
    old, new = body.sample(0), body.sample(1)
    assert between(old, new, 1.0) is new
    assert torch.allclose(between(old, new, 0.5).force, (old.force + new.force) / 2)


def test_the_scale_is_round_and_does_not_tremble():
    assert [round_up(x) for x in (0.0, 1.0, 1.2, 7.0, 9.0, 480.0)] == [0, 1, 1.5, 8, 10, 500]
    scale = Scale()
    tops = [scale.follow(np.array([0.0, top])) for top in (4.1, 4.9, 5.2, 4.1, 1.0)]
    assert tops == [5, 5, 6, 6, 1]
    assert scale.follow(np.array([np.nan, np.inf])) == 0

"""Dirichlet conditions (prescribed displacements) and Robin conditions (elastic foundations)."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from solving import assert_derivatives, bar, rest, sliding
from torch.testing import assert_close

from dpl import fem
from dpl.fem.linear import full_matrix

NH = fem.NeoHookeanLn(0.3)
LEFT, RIGHT = fem.Plane(0, "min"), fem.Plane(0, "max")
NOTHING = fem.Plane(0, 0.4321)


@pytest.fixture(params=[("quad", 2), ("tetra", 1)], ids=str)
def element(request) -> tuple[str, int]:
    """Shape of the cell and degree in the plane and in space, for what no element changes."""
    return request.param


@pytest.fixture
def dim(element) -> int:
    """Dimension of the element."""
    return 3 if element[0] == "tetra" else 2


@pytest.fixture
def held(element, grid):
    """Builds unit bodies, lengths over 4 m, with supports."""

    def held(*supports, **options) -> fem.Problem:
        mesh = grid(element[0], 2, 0.12, inside=True).scaled(4.0)
        return fem.Problem.build(mesh, NH, supports=supports, degree=element[1], **options)

    return held


def answer_of(problem: fem.Problem, force: torch.Tensor | None = None, **options):
    """Return the solution under a load, none if left out."""
    load = fem.Load(rest(problem) if force is None else force[None], torch.ones(1))
    return fem.solve(fem.Newton(problem, linear="superlu", **options), load)


ZERO, X = [0.0, 0.0, 0.0], [None, 0.0, None]
SUPPORTS = {  # region and value [m] of each condition, is x = 0 fixed, u/L at x = 0 and x = L
    "no value is zero for all components": ([(LEFT, None)], False, {0: ZERO}),
    "`fixed` is zero for all components": ([], True, {0: ZERO}),
    "a component without a value is free": ([(LEFT, X)], False, {0: X}),
    "a value is a length": ([(RIGHT, [0.4, None, -0.2])], False, {1: [0.1, None, -0.05]}),
    "the last value applies": (
        *([(LEFT, [0.4] * 3), (LEFT, [-0.8, None, None])], False),
        {0: [-0.2, 0.1, 0.1]},
    ),
    "the last value applies, reversed": (
        *([(LEFT, [-0.8, None, None]), (LEFT, [0.4] * 3)], False),
        {0: [0.1] * 3},
    ),
    "a value overrides `fixed`": ([(LEFT, [0.4, None, None])], True, {0: [0.1, 0.0, 0.0]}),
    "no value does not free what `fixed` holds": ([(LEFT, X)], True, {0: ZERO}),
    "regions add up": ([(LEFT, None), (RIGHT, None)], False, {0: ZERO, 1: ZERO}),
}


@pytest.mark.parametrize("case", SUPPORTS)
def test_supports_prescribe_displacements_in_metres(held, dim, case):
    conditions, fixed, ends = SUPPORTS[case]
    supports = [fem.DirichletBC(region, value and value[:dim]) for region, value in conditions]
    problem = held(*supports, fixed=LEFT if fixed else None)
    expected = torch.full(problem.shape, math.nan, dtype=torch.float64)
    for x, value in ends.items():
        row = [math.nan if one is None else one for one in value[:dim]]
        expected[(problem.points[:, 0] - x).abs() < 1e-9] = torch.tensor(row, dtype=torch.float64)
    assert problem.length == pytest.approx(4.0)
    assert not problem.prescribed[problem.free].any()
    found = problem.prescribed.masked_fill(problem.free, math.nan)
    assert_close(found, expected, rtol=1e-14, atol=0, equal_nan=True)
    assert problem.moved_supports == bool(expected.nan_to_num().any())


@pytest.mark.parametrize(
    ("cell", "support", "message"),
    [
        *(
            ("hexahedron", fem.DirichletBC(LEFT, value), "must be 3 lengths")
            for value in (
                *([], [0.0], [0.0] * 4, [None] * 3, [0.0, math.inf, 0.0], [math.nan] * 3),
            )
        ),
        ("quad", fem.DirichletBC(LEFT, [0.0, 0.0, 0.0]), "must be 2 lengths"),
        ("quad", fem.DirichletBC(NOTHING), "no node"),
        ("quad", fem.RobinBC(NOTHING, 1.0), "no facet of the boundary"),
        *(
            ("hexahedron", fem.RobinBC(LEFT, stiffness), "stiffness")
            for stiffness in (
                *(0.0, -1.0, math.nan, [0.0] * 3, [1.0, -1.0, 1.0], [1.0, 1.0], [1.0] * 4),
                [math.nan, 1.0, 1.0],
            )
        ),
    ],
    ids=str,
)
def test_invalid_support_is_an_error(grid, cell, support, message):
    with pytest.raises(ValueError, match=message):
        fem.Problem.build(grid(cell), NH, supports=[support])


def test_moved_supports_stretch_the_body():
    """A bar stretched by 50 % has the lateral stretch of uniaxial stress."""
    mesh = fem.box([2.0, 2.0, 2.0], [3, 3, 3])
    pulled = fem.DirichletBC(RIGHT, [1.0, None, None])
    for law, lateral in ((fem.SaintVenantKirchhoff(0.3), 0.79056942), (NH, 0.88017459)):
        problem = fem.Problem.build(mesh, law, supports=[*sliding(3), pulled])
        answer = answer_of(problem, tol=1e-12)
        assert answer.converged.all()
        end = 1 + answer.displacement[0, problem.points.sum(dim=1).argmax()]
        assert end.tolist() == pytest.approx([1.5, lateral, lateral], abs=6e-9)


def test_supports_move_with_the_load():
    """An equilibrium under half the load has half the displacement at the supports."""
    mesh = fem.rectangle([4.0, 1.0], [9, 3])
    ends = [fem.DirichletBC(LEFT), fem.DirichletBC(RIGHT, [4.0, 1.0])]
    problem = fem.Problem.build(mesh, NH, supports=ends)
    right = problem.points[:, 0] > 1 - 1e-9
    for budget, factor in ((10, 0.5), (30, 1.0)):  # three iterations are too few for the whole
        answer = answer_of(problem, max_iter=3, max_total_iter=budget, mixed_integration=False)
        assert answer.load_factor.item() == factor
        assert answer.converged.item() == (factor == 1.0)
        moved = answer.displacement[0, right]
        expected = factor * torch.tensor([1.0, 0.25], dtype=torch.float64)
        assert_close(moved, expected.expand_as(moved), rtol=1e-14, atol=0)


# Bar of length 4 with nu = 0, Saint Venant-Kirchhoff, traction t = 0.1 on x = 4 and foundation
# alpha = 0.5 on x = 0: its stretch s solves s^3 - s = 2 t, u(0) = t / alpha.
STRETCH, START, END = 1.0880339146912892, 0.2, 0.5521356587651567


def bar_on_springs(kind, count: int, stiffness) -> fem.Problem:
    """Return the bar on an elastic foundation, in 3D or 2D."""
    cell, degree = kind
    mesh = bar(cell, count)
    shift = np.random.default_rng(0).uniform(-0.1, 0.1, mesh.p.shape) / count
    shift[:, mesh.boundary_nodes()] = 0.0
    shift[0, (mesh.p[0] > 0) & (mesh.p[0] < 4)] = 0.3 / count  # cells of two lengths
    mesh = type(mesh)(mesh.p + shift, mesh.t)
    law = fem.SaintVenantKirchhoff(0.0)
    return fem.Problem.build(mesh, law, supports=[fem.RobinBC(LEFT, stiffness)], degree=degree)


def check_bar(problem: fem.Problem) -> None:
    force = fem.Traction(RIGHT, [0.1, *[0.0] * (problem.shape[1] - 1)]).on(problem)
    answer = answer_of(problem, force, tol=1e-13)
    assert answer.converged.all()
    x, u = problem.points[:, 0] * problem.length, answer.displacement[0] * problem.length
    assert_close(u[:, 0], START + (STRETCH - 1) * x, rtol=0, atol=1e-10)
    assert u[:, 1:].abs().max() < 1e-10
    ends = [u[x < 1e-9, 0], u[x > 4 - 1e-9, 0]]
    for end, expected in zip(ends, (START, END), strict=True):
        assert end.tolist() == [pytest.approx(expected, abs=1e-10)] * len(end)


@pytest.mark.parametrize("count", [1, 3])
def test_bar_on_springs_is_exact_on_every_mesh(kind, count):
    problem = bar_on_springs(kind, count, 0.5)
    assert problem.unconstrained_rigid_body_modes() == []
    check_bar(problem)


def test_bar_on_springs_does_not_depend_on_the_unit_of_length(element):
    """A bar of 0.004 m with alpha / E = 500/m and a displacement in metres."""
    problem = bar_on_springs(element, 3, 0.5)
    mesh = problem.mesh.scaled(0.004)
    small = fem.Problem.build(
        mesh, problem.material, supports=[fem.RobinBC(LEFT, 500.0)], degree=problem.degree
    )
    assert small.length == pytest.approx(0.004)
    assert_close(small.springs.stiffness, problem.springs.stiffness, rtol=1e-12, atol=1e-15)


def test_stiffness_may_differ_from_direction_to_direction(element, dim):
    """The pull along x does not feel the other two; those in plane must hold the body."""
    check_bar(bar_on_springs(element, 3, [0.5, 2.0, 7.0][:dim]))


def test_unconstrained_rigid_body_modes_on_springs_are_the_zero_modes(element, dim):
    for axis in range(dim):
        stiffness = [0.0] * dim
        stiffness[axis] = 0.5
        problem = bar_on_springs(element, 1, stiffness)
        names = problem.unconstrained_rigid_body_modes()
        assert f"translation along {'xyz'[axis]}" not in names
        assert {f"translation along {'xyz'[k]}" for k in range(dim) if k != axis} <= set(names)
        tangent = problem.tangent(rest(problem))[0].numpy()
        K = full_matrix(problem.pattern, tangent).toarray()
        values = np.linalg.eigvalsh(K)
        assert (values < 1e-10 * values[-1]).sum() == len(names)


def test_springs_and_clamps_hold_together(held, dim):
    """A hinge line or point leaves rotations; springs at the other end take them."""
    corner = fem.Box([0.0] * dim, [0.0] * dim)
    pinned = held(fem.DirichletBC(corner))
    assert len(pinned.unconstrained_rigid_body_modes()) == {2: 1, 3: 3}[dim]
    assert (
        held(fem.DirichletBC(corner), fem.RobinBC(RIGHT, 1e-3)).unconstrained_rigid_body_modes()
        == []
    )


def test_soft_springs_hold_as_well_as_stiff_ones(element):
    for stiffness in (1e-9, 1.0, 1e9):
        assert bar_on_springs(element, 2, stiffness).unconstrained_rigid_body_modes() == []


@pytest.fixture
def sprung(held, dim) -> fem.Problem:
    """Unequal cells, held in part, two beds of springs on neighbouring faces."""
    return held(
        fem.DirichletBC(fem.Box([0.0] * dim, [4.0, *[0.0] * (dim - 1)]), [None, 0.0, None][:dim]),
        fem.RobinBC(LEFT, [0.3, 0.1, 0.7][:dim]),
        fem.RobinBC(fem.Plane(1, "max"), 0.2),
    )


def test_force_and_tangent_on_springs_are_slopes_of_energy_and_force(sprung, bend):
    u = bend(sprung.points, 2)
    assert_derivatives(sprung, u, bend(sprung.points, 2, seed=1))
    assert_close(sprung.evaluate(u).internal, sprung.internal_force(u), rtol=1e-11, atol=1e-13)
    tangent = sprung.linearise(u[:1]).tangent
    assert_close(tangent, sprung.tangent(u[:1]), rtol=1e-10, atol=1e-13)


def test_force_of_springs_is_stiffness_times_displacement_times_area(held, dim):
    """A body moved as a whole: the pull is -alpha u, on an area of 4 m by 4 m."""
    stiffness = np.array([0.3, 0.1, 0.7][:dim])
    problem = held(fem.RobinBC(LEFT, stiffness.tolist()))
    shift = torch.tensor([0.05, -0.02, 0.01][:dim], dtype=torch.float64)
    u = shift.expand(1, *problem.shape)
    total = problem.internal_force(u).sum(dim=1)[0]
    expected = torch.from_numpy(stiffness * 4.0) * shift  # times L; the face's area is 1
    assert_close(total, expected, rtol=1e-12, atol=1e-15)
    assert_close(problem.energy(u), (expected * shift).sum()[None] / 2, rtol=1e-12, atol=0)


def test_foundations_on_one_face_add_up(held, bend):
    one, two = held(fem.RobinBC(LEFT, 0.3), fem.RobinBC(LEFT, 0.2)), held(fem.RobinBC(LEFT, 0.5))
    u = bend(one.points)
    assert_close(one.internal_force(u), two.internal_force(u), rtol=1e-12, atol=1e-15)
    assert_close(one.tangent(u), two.tangent(u), rtol=1e-12, atol=1e-15)


def test_very_stiff_springs_act_as_a_clamp(element):
    """The difference falls with the stiffness, by 10 where it is ten times as large."""
    mesh, degree = bar(element[0], 4), element[1]
    law, value = fem.LinearElastic(0.3), [0.0, 1e-4, 0.0][: mesh.dim()]

    def sag(**supports):
        problem = fem.Problem.build(mesh, law, degree=degree, **supports)
        force = fem.Traction(RIGHT, value).on(problem)
        answer = answer_of(problem, force)
        assert answer.converged.all()
        return (answer.displacement[0] * force).sum().item()

    clamped = sag(fixed=LEFT)
    softer, stiffer = (sag(supports=[fem.RobinBC(LEFT, a)]) / clamped - 1 for a in (1e3, 1e4))
    assert 0 < stiffer < 1e-2
    assert softer / stiffer == pytest.approx(10, rel=0.05)


def test_copies_on_a_device_and_by_pickle_contain_the_springs(sprung, bend):
    u = bend(sprung.points)
    for copy in (sprung.to("cpu"), pickle.loads(pickle.dumps(sprung))):
        assert torch.equal(copy.internal_force(u), sprung.internal_force(u))
        assert torch.equal(copy.linearise(u).tangent, sprung.linearise(u).tangent)
        assert copy.length == sprung.length
        assert replace(copy, material=NH).pattern is copy.pattern
    bare = replace(sprung, springs=None)
    assert (bare.internal_force(u) - sprung.internal_force(u)).abs().max() > 1e-4

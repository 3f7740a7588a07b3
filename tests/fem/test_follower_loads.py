"""Laws of follower loads: force, stiffness, potential, solvers, closed forms, refusals."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from scipy.optimize import fsolve
from scipy.sparse import tril, triu
from solving import load_of, rest, sliding
from torch.testing import assert_close

from benchmarks.verification.pressurised import (
    energy_balance,
    expanded_radius,
    expansion,
    inner_surface,
    sector,
)
from dpl import fem
from dpl.fem.assembly.follower_loads import NO_LOADS
from dpl.fem.linear.interface import full_matrix
from dpl.fem.postprocess import potential_energy

NH = fem.NeoHookeanLn(0.3)
START, END, TOP = fem.Plane(0, "min"), fem.Plane(0, "max"), fem.Plane(2, "max")
LOWER = fem.Box([-1.0, -1.0, -1.0], [5.0, 2.0, 0.5])
ALONG_X = fem.ConstantFibres([1.0, 0.0, 0.0])
OBLIQUE = fem.ConstantFibres([1.0, 0.6, 0.3])
AROUND = fem.FollowerPressure(lambda points: np.ones(len(points), dtype=bool), 0.3)
MUSCLE = fem.ActiveStress(0.1, directions=OBLIQUE)
KINDS = ["closed pressure", "open pressure", "active stress"]
ELEMENTS = list(product(("triangle", "quad", "tetra", "hexahedron"), (1, 2)))
BENT = [(KINDS[number % 3], element) for number, element in enumerate(ELEMENTS)]
BENT += [(KINDS[(number + 1) % 3], element) for number, element in enumerate(ELEMENTS[2:6])]
BENT += [("cable", element) for element in ELEMENTS]


def first_half(points):
    return points[:, 0] < 0.5


def cable(value, dim=3):
    """Return a cable with a kink, whose ends lie in cells that have no common node."""
    points = [[0.1, 0.2, 0.3], [0.5, 0.7, 0.6], [0.9, 0.3, 0.7]]
    return fem.FollowerCable([point[:dim] for point in points], value)


def solved(newton):
    return fem.solve(newton, load_of(rest(newton.problem)))


def swirl(points):
    """Return fibre directions that differ from cell to cell, (E, 3)."""
    x = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    return np.stack([np.cos(x[:, 1]), np.sin(x[:, 0] + x[:, 1]), 0.3 + x[:, 2]], axis=1)


@pytest.fixture(params=BENT, ids=str)
def bent(request, grid, bend):
    """A body of each kind of element under a kind of load, and a displacement."""
    name, (cell, degree) = request.param
    mesh = grid(cell, 2, 0.0 if name == "open pressure" else 0.15)
    loads = {
        "closed pressure": [AROUND],
        "open pressure": [fem.FollowerPressure(END, 0.3)],
        "active stress": [
            fem.ActiveStress(0.3, directions=fem.FibreFunction(swirl)),
            fem.ActiveStress(0.2, region=first_half, directions=OBLIQUE),
        ],
        "cable": [cable(0.3, mesh.dim()), fem.FollowerCable(mesh.p.T[[0, -1]].tolist(), 0.1)],
    }[name]
    fixed = None if name == "closed pressure" else START
    problem = fem.Problem.build(
        mesh, NH, fixed=fixed, degree=degree, follower_loads=loads, length=1.0
    )
    return name, problem, bend(problem.points, seed=3)


def test_force_is_the_gradient_of_the_work_if_there_is_a_potential(bent):
    name, problem, u = bent
    assert problem.has_potential == (name != "open pressure")
    u = u.clone().requires_grad_()
    (slope,) = torch.autograd.grad(problem.energy(u).sum(), u)
    gap = (slope - problem.internal_force(u).detach()).abs().max()
    assert (gap < 1e-10 * slope.abs().max()) == problem.has_potential


def test_tangent_is_the_derivative_of_the_force(bent):
    """By central differences, to 1e-7; symmetric and skew part, by compiled loops and tensors."""
    _, problem, u = bent
    v = torch.from_numpy(np.random.default_rng(2).normal(size=u.shape)) * problem.free
    step, loads = 1e-5, problem.follower_loads
    slope = (loads.force(u + step * v) - loads.force(u - step * v)) / (2 * step)
    system = problem.linearise(u)
    elastic = replace(problem, follower_loads=NO_LOADS).linearise(u)
    matrix = full_matrix(problem.pattern, (system.tangent - elastic.tangent)[0].numpy())
    assert (system.skew is None) == problem.has_potential
    if system.skew is not None:
        skew = full_matrix(problem.pattern, system.skew[0].numpy())
        matrix = matrix + triu(skew) - tril(skew)
    found, expected = matrix @ problem.restrict(v[0]), problem.restrict(slope[0])
    assert np.abs(found - expected).max() < 1e-7 * np.abs(expected).max()
    assert_close(problem.tangent(u), system.tangent, rtol=1e-10, atol=1e-12)


def test_forces_on_a_body_in_equilibrium_have_no_resultant(bent):
    """A closed surface, a stress and a cable have neither force nor moment."""
    name, problem, u = bent
    force = problem.follower_loads.force(u)[0]
    x, size = problem.points + u[0], force.abs().sum()
    balanced = force.sum(dim=0).abs().max() < 1e-14 * size
    assert balanced == (name != "open pressure")
    if balanced:
        dipole = x.T @ force
        assert (dipole - dipole.T).abs().max() < 1e-14 * size


def test_forces_rotate_with_the_body(bent):
    _, problem, u = bent
    dim = problem.shape[1]
    Q = torch.linalg.qr(torch.from_numpy(np.random.default_rng(1).normal(size=(dim, dim))))[0]
    Q[:, 0] *= torch.linalg.det(Q)  # a rotation
    turned = ((problem.points + u) @ Q.T) - problem.points
    force = problem.follower_loads.force(u) @ Q.T
    assert_close(problem.follower_loads.force(turned), force, rtol=1e-12, atol=1e-14)


def test_linear_solution_is_that_of_the_forces_at_rest(bent):
    """K(0) excludes the stiffness of follower loads."""
    _, problem, _ = bent
    elastic = replace(problem, follower_loads=NO_LOADS)
    zero = rest(problem)
    assert_close(problem.stiffness_at_rest(), elastic.tangent(zero)[0], rtol=1e-9, atol=1e-12)
    assert (problem.tangent(zero)[0] - problem.stiffness_at_rest()).abs().max() > 1e-3


def test_potential_exists_where_the_edge_is_fixed_or_slides_in_a_plane(grid):
    mesh, load = grid("hexahedron"), fem.FollowerPressure(TOP, 0.1)
    sides = [
        fem.DirichletBC(fem.Plane(axis, at), [0.0 if i == axis else None for i in range(3)])
        for axis in (0, 1)
        for at in ("min", "max")
    ]
    for count in (3, 4):
        problem = fem.Problem.build(
            mesh, NH, fixed=fem.Plane(2, "min"), supports=sides[:count], follower_loads=[load]
        )
        assert problem.has_potential == (count == 4)


def test_work_is_pressure_times_volume(grid):
    """A cube of side 1 under pressure that grows to side 1.2."""
    problem = fem.Problem.build(grid("tetra"), NH, follower_loads=[AROUND], length=1.0)
    work = problem.follower_loads.work(0.2 * problem.points[None])
    assert float(work) == pytest.approx(0.3 * (1.2**3 - 1), rel=1e-13)


def test_small_pressure_acts_as_a_dead_load_on_the_surface_at_rest(kind, grid):
    """The linear solutions agree to rounding, Newton's to the order of the pressure."""
    cell, degree = kind
    p, mesh = 1e-6, grid(cell, 2)
    dead = fem.Problem.build(mesh, NH, fixed=START, degree=degree, length=1.0)
    problem = fem.Problem.build(
        mesh, NH, fixed=START, degree=degree, length=1.0,
        follower_loads=[fem.FollowerPressure(END, p)],
    )  # fmt: skip
    force = fem.Traction(END, [-p] + [0.0] * (mesh.dim() - 1)).on(dead)
    linear = solved(fem.LinearSolver(problem)).displacement
    assert_close(linear[0], fem.LinearSolver(dead).solve(force), rtol=1e-10, atol=1e-18)
    if degree == 1:
        found = solved(fem.Newton(problem))
        assert found.converged.all()
        assert (found.displacement - linear).norm() < 1e-5 * linear.norm()


@pytest.fixture(scope="module")
def beam():
    def beam(*loads, **options):
        mesh = fem.box([4.0, 1.0, 1.0], [9, 3, 3])
        return fem.Problem.build(mesh, NH, fixed=START, follower_loads=loads, **options)

    return beam


def above(p):
    """Return a pressure without potential."""
    return fem.FollowerPressure(TOP, p)


def test_newton_converges_quadratically_without_a_potential(beam, mixed):
    newton = fem.Newton(beam(above(2e-3)), tol=1e-12, mixed_integration=mixed)
    residuals = [float(s.residual) for s in newton.iterate(load_of(rest(newton.problem)))]
    assert residuals[-1] < 1e-12
    assert residuals[0] == 1.0
    assert len(residuals) <= 8
    before, last = residuals[-3:-1]
    assert last < 0.1 * before


def test_load_steps_and_the_corotated_factor_lead_to_the_same_solution(beam):
    solver = fem.Newton(beam(above(1e-2)), linear="superlu")
    found = solved(solver)
    assert found.converged.all()
    assert float(found.displacement.abs().max()) > 0.4
    for other in (
        replace(solver, max_iter=4),
        replace(solver, corotational=True, factor_reuse_tol=1.0),
    ):
        answer = solved(other)
        assert answer.converged.all()
        assert_close(answer.displacement, found.displacement, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("mean_dilatation", [False, True])
def test_a_muscle_on_one_side_bends_a_beam(beam, mean_dilatation):
    muscle = fem.ActiveStress(0.2, region=LOWER, directions=ALONG_X)
    newton = fem.Newton(beam(muscle, mean_dilatation=mean_dilatation))
    found, stepped = solved(newton), solved(replace(newton, max_iter=3))
    assert found.converged.all()
    assert float(found.displacement[0, :, 2].min()) < -0.02
    assert stepped.converged.all()
    assert_close(stepped.displacement, found.displacement, rtol=0, atol=1e-7)


@pytest.mark.parametrize("load", [above(4e-3), fem.ActiveStress(0.2, directions=OBLIQUE)])
def test_half_the_stress_is_half_the_load_factor(beam, load):
    whole, half = beam(load), beam(replace(load, value=load.value / 2))
    found, expected = (solved(fem.Newton(body)) for body in (whole.under(0.5), half))
    assert_close(found.displacement, expected.displacement, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("value", [1e-9, 1e-3])
@pytest.mark.parametrize("load", [above(1.0), MUSCLE])
def test_residual_is_relative_to_the_forces_at_rest(beam, load, value):
    """With no other force ||R||/||f|| is 1 at rest and does not depend on the unit of stress."""
    problem = beam(replace(load, value=value))
    nothing = rest(problem)
    assert float(problem.relative_residual(nothing, nothing)) == pytest.approx(1.0, rel=1e-14)


def test_active_stress_pressure_and_dead_load_act_together(beam):
    pressure = above(2e-3)
    muscle = fem.ActiveStress(0.05, region=LOWER, directions=ALONG_X)
    problem = beam(muscle, pressure)
    assert not problem.has_potential
    u = torch.from_numpy(np.random.default_rng(0).normal(size=(1, *problem.shape))) * 1e-2
    alone = [beam(one).follower_loads.force(u) for one in (muscle, pressure)]
    assert_close(problem.follower_loads.force(u), sum(alone), rtol=1e-12, atol=1e-16)
    tangents = [beam(*own).tangent(u) for own in ((muscle, pressure), (muscle,), (pressure,), ())]
    both, first, second, none = tangents
    assert_close(both - none, first + second - 2 * none, rtol=1e-9, atol=1e-13)
    force = fem.Traction(END, [0.0, 0.0, 1e-3]).on(problem)[None]
    found = fem.solve(fem.Newton(problem), load_of(force))
    assert found.converged.all()
    residual = problem.residual(found.displacement, force)
    scale = max(problem.acting(f).norm() for f in (force, problem.force_at_rest))
    assert residual.norm() < 1e-8 * scale


@pytest.mark.parametrize("load", [above(1e-2), MUSCLE])
def test_gradients_of_solutions_agree_with_differences(beam, load):
    problem = beam(load)
    equilibrium = fem.DifferentiableSolve(fem.Newton(problem, tol=1e-12))
    random = np.random.default_rng(3)
    force = torch.from_numpy(1e-5 * random.normal(size=(1, *problem.shape))) * problem.free
    weights, way = (torch.from_numpy(random.normal(size=force.shape)) for _ in "ab")
    way = 1e-5 * way * problem.free

    def value(f):
        return (weights * equilibrium(fem.Load(f, torch.ones(1)))).sum()

    force.requires_grad_()
    (gradient,) = torch.autograd.grad(value(force), force)
    with torch.no_grad():
        slope = (value(force + 0.01 * way) - value(force - 0.01 * way)) / 0.02
    assert float((gradient * way).sum()) == pytest.approx(float(slope), rel=3e-5)


@pytest.mark.parametrize(
    ("load", "count"),
    [
        (fem.FollowerPressure(TOP, 0.1), 2),
        (fem.FollowerPressure(END, 0.1), 8),
        (fem.ActiveStress(0.1, directions=ALONG_X), 8),
        (fem.ActiveStress(0.1, directions=fem.ConstantFibres([1.0, 1.0, 0.0])), 2),
        (fem.FollowerCable([[0.0, 0.5, 0.5], [1.0, 0.5, 0.5]], 0.1), 8),
        (fem.FollowerCable([[0.0, 0.5, 0.2], [1.0, 0.5, 0.2]], 0.1), 2),
    ],
)
def test_follower_loads_count_for_symmetries(grid, load, count):
    problem = fem.Problem.build(grid("hexahedron"), NH, fixed=START, follower_loads=[load])
    assert len(fem.symmetries(problem)) == count


def test_directions_are_those_of_the_law_unless_given(grid):
    """Of a law with fibres, and of each region of a body of several laws."""
    mesh = grid("hexahedron")
    muscle = fem.FibreReinforced(NH, fem.Guccione(c=0.1, bf=8.0, bt=2.0, bfs=4.0), OBLIQUE)

    def force(law, load):
        return fem.Problem.build(mesh, law, fixed=START, follower_loads=[load]).force_at_rest

    expected = force(NH, fem.ActiveStress(0.3, directions=OBLIQUE))
    assert_close(force(muscle, fem.ActiveStress(0.3)), expected)
    half = {"muscle": first_half}
    several = fem.Heterogeneous({"muscle": muscle, "other": NH}, half)
    expected = force(NH, fem.ActiveStress(0.3, region=first_half, directions=OBLIQUE))
    assert_close(force(several, fem.ActiveStress(0.3, region=first_half)), expected)
    turning = fem.FibreFunction(swirl)
    swirling = replace(muscle, directions=turning)
    expected = force(NH, fem.ActiveStress(0.3, region=first_half, directions=turning))
    several = fem.Heterogeneous({"other": NH, "muscle": swirling}, half)
    assert_close(force(several, fem.ActiveStress(0.3, region=first_half)), expected)
    with pytest.raises(ValueError, match=r"active_stress: no fibre directions .* in 4 of 8 cells"):
        force(several, fem.ActiveStress(0.3))


@pytest.mark.parametrize(
    ("load", "message"),
    [
        (AROUND, r"value = nan must be a finite number or"),
        (replace(AROUND, value=[1.0, 0.0]), r"value = .* low below high"),
        (replace(AROUND, value=[1.0, 0.0, 0.0]), r"value = .* no direction"),
        (replace(AROUND, value=True), r"value = True must be"),
        (replace(AROUND, value="soft"), r"value = soft must be"),
        (fem.ActiveStress(0.1), "no fibre directions are known in 8 of 8 cells; set directions"),
        (replace(MUSCLE, value=[1.0, 0.0, 0.0]), r"value = .* along the fibres"),
        (replace(MUSCLE, region=fem.Box([5, 5, 5], [6, 6, 6])), "holds no cell"),
        (replace(MUSCLE, directions=fem.ConstantFibres([1.0, 0.0])), "must have 3 components"),
        (replace(cable(0.1), value=[1.0, 0.0, 0.0]), r"value = .* along the cable"),
        (replace(cable(0.1), value=True), r"value = True must be a finite number or .*\[N\]"),
        (replace(cable(0.1), points=[[0, 0, 0]]), "points = .* must be two or more points of 3"),
        (cable(0.1, 2), "points = .* must be two or more points of 3"),
        (replace(cable(0.1), points=[[0, 0, 0]] * 2), "must not contain the same point twice in"),
        (replace(cable(0.1), points=[[0, 0, 0], [1, 1, 9]]), "point .1.0, 1.0, 9.0. .m. must lie"),
    ],
)
def test_invalid_loads_are_refused_in_one_line(load, message, grid):
    load = replace(load, name="own", value=math.nan if "nan" in message else load.value)
    with pytest.raises(ValueError, match=message) as error:
        fem.Problem.build(grid("hexahedron"), NH, follower_loads=[load])
    assert str(error.value).startswith("follower_loads.own: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "load", [fem.FollowerPressure(END, 5.0), fem.ActiveStress(5.0, directions=ALONG_X)]
)
def test_follower_loads_need_one_modulus(grid, load):
    mesh, kind = grid("quad"), type(load).__name__.replace("S", " s").replace("P", " p").lower()
    with pytest.raises(ValueError, match="young is a range"):
        fem.Problem.build(mesh, NH, follower_loads=[load], young=None)
    problem = fem.Problem.build(mesh, NH, follower_loads=[load], young=50.0)
    largest = problem.force_at_rest[:, 0][problem.points[:, 0] == 1].sum()
    assert abs(float(largest)) == pytest.approx(0.1, rel=1e-12)
    with pytest.raises(ValueError, match=f"by which the {kind} is divided"):
        problem.check_modulus(40.0)


def test_potential_energy_needs_a_potential(beam):
    problem = beam(above(1e-3))
    load = load_of(rest(problem))
    with pytest.raises(ValueError, match="has no potential"):
        potential_energy(load.force, load, problem)


# ------------------------------------------------------------------ known solutions


@pytest.mark.parametrize(
    ("cell", "tension"), [("quad", 0.3), ("tetra", -0.2), ("hexahedron", -0.2), ("hexahedron", 1.5)]
)
def test_a_free_block_shortens_as_the_closed_form(cell, tension, grid):
    """P_11 = 0 and P_22 = 0 give the two stretches; plane strain in 2D."""
    mesh = grid(cell, 2, 0.15, inside=True)
    dim = mesh.dim()

    def stresses(stretches):
        a, b = stretches
        change = NH.lam * math.log(a * b ** (dim - 1))
        return (
            NH.mu * (a - 1 / a) + change / a + tension * a,
            NH.mu * (b - 1 / b) + change / b,
        )

    a, b = fsolve(stresses, [0.9, 1.05], xtol=1e-14)
    muscle = fem.ActiveStress(tension, directions=ALONG_X)
    problem = fem.Problem.build(
        mesh, NH, supports=sliding(dim), follower_loads=[muscle], length=1.0
    )
    newton = fem.Newton(problem, tol=1e-12)
    found = solved(newton)
    assert found.converged.all()
    stretches = torch.tensor([a, *[b] * (dim - 1)]).double()
    moved = problem.points + found.displacement[0]
    assert_close(moved, problem.points * stretches, rtol=0, atol=1e-10)
    linear = newton.linear_solver.solve(rest(problem)[0])
    shortening = tension * (1 - (NH.poisson**2 if dim == 2 else 0.0))  # Hooke, E = 1
    assert float(linear[:, 0].abs().max()) == pytest.approx(abs(shortening), rel=1e-10)


def test_a_rotated_body_with_rotated_fibres_and_load_has_the_rotated_solution():
    rng = np.random.default_rng(5)
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    Q *= np.linalg.det(Q)
    mesh = fem.box([1.0, 0.5, 0.5], [4, 3, 3])
    fibre, pull = np.array([1.0, 0.5, 0.2]), np.array([0.0, 1e-4, 2e-4])

    def answer(rotation):
        muscle = fem.ActiveStress(0.1, directions=fem.ConstantFibres(rotation @ fibre))
        turned = type(mesh)(rotation @ mesh.p, mesh.t)
        problem = fem.Problem.build(
            turned, NH, fixed=mesh.p[0] < 1e-9, follower_loads=[muscle], length=1.0
        )
        force = torch.from_numpy(np.tile(rotation @ pull, (problem.shape[0], 1)))[None]
        return fem.solve(fem.Newton(problem, tol=1e-11), load_of(force)).displacement[0]

    usual, turned = answer(np.eye(3)), answer(Q)
    assert usual.abs().max() > 0.02
    assert_close(turned, usual @ torch.from_numpy(Q.T), rtol=0, atol=1e-9)


def strip(tension, points):
    """Return a clamped strip of 20 x 1 in plane strain with a cable, and Newton's solution."""
    mesh = fem.rectangle([20.0, 1.0], [21, 3], "quad")
    pull = fem.FollowerCable(points, tension)
    problem = fem.Problem.build(mesh, NH, fixed=START, degree=2, follower_loads=[pull], length=1.0)
    return problem, solved(fem.Newton(problem))


PLANE_MODULUS = 1 / (1 - NH.poisson**2)  # E / (1 - nu^2), the modulus of bending in plane strain


@pytest.mark.parametrize(("ratio", "is_stable"), [(0.97, True), (1.03, False)])
def test_a_cable_from_the_end_to_the_support_buckles_a_column_at_pi_squared(ratio, is_stable):
    """A load through a fixed point of the support: 4 times Euler's load of the cantilever.

    Source: Timoshenko, Gere (1961), Theory of Elastic Stability, section 2.5.
    """
    critical = math.pi**2 * PLANE_MODULUS / 12 / 20**2
    _, found = strip(ratio * critical, [[0.0, 0.5], [20.0, 0.5]])
    assert found.converged.all()
    assert (int(found.negative_pivots) == 0) == is_stable


@pytest.mark.parametrize("angle", [0.1, 1.0])
def test_a_guided_cable_bends_a_beam_to_an_arc(angle):
    """T e = E' I kappa, for any rotation, where each section guides the cable at the height e."""
    tension = angle * PLANE_MODULUS / 12 / (20 * 0.4)
    problem, found = strip(tension, [[float(x), 0.9] for x in range(21)])
    x = (problem.points + found.displacement[0])[problem.points[:, 0] == 20.0]
    across = x[x[:, 1].argmax()] - x[x[:, 1].argmin()]
    assert float(torch.atan2(-across[0], across[1])) == pytest.approx(angle, rel=0.01)


def test_pressure_beyond_the_limit_point_has_no_valid_equilibrium():
    """A neo-Hookean sphere or cylinder has a largest internal pressure."""
    mesh, load = sector(2, 1, "quad", quadratic=True), fem.FollowerPressure(inner_surface, 0.6)
    problem = fem.Problem.build(
        mesh, NH, degree=2, supports=sliding(2), follower_loads=[load], length=1.0
    )
    found = solved(fem.Newton(problem, min_load_step=2.0**-3))
    assert int(found.status) == fem.Status.NO_VALID_EQUILIBRIUM
    assert found.load_factor < 0.9


def test_thick_cylinder_expands_as_the_radial_solution():
    """Quadratic quadrilaterals: order 4, and 1e-6 on 8 cells."""
    nu = 0.49
    exact = expanded_radius(nu, 0.15, 2)
    coarse, fine = (
        expansion(nu, 0.15, sector(2, n, "quad", quadratic=True), 2) / exact - 1 for n in (4, 8)
    )
    assert abs(fine) < 5e-6
    assert 3.5 < np.log2(coarse / fine) < 4.5
    extrapolated = (16 * fine - coarse) / 15
    assert abs(extrapolated) < 1e-6


def test_thick_sphere_expands_as_the_radial_solution():
    exact = expanded_radius(0.3, 0.2, 3)
    errors = [
        expansion(0.3, 0.2, sector(3, n, "hexahedron", quadratic=True), 2) / exact - 1
        for n in (1, 2)
    ]
    assert abs(errors[1]) < 2e-3
    assert abs(errors[0] / errors[1]) > 6


def test_work_of_the_pressure_is_the_strain_energy_of_a_finger_that_bends():
    strain, work, tip = energy_balance((10, 4, 4))
    assert work == pytest.approx(strain, rel=1e-6)
    assert tip > 0.02

"""Laws of active stress: energy, stiffness, closed form, objectivity, directions, refusals."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import fsolve
from torch.testing import assert_close

from dpl.fem import (
    ActiveStress,
    Box,
    ConstantFibres,
    DifferentiableSolve,
    DirichletBC,
    FibreFunction,
    FibreReinforced,
    FollowerPressure,
    Guccione,
    Heterogeneous,
    Load,
    NeoHookeanLn,
    Newton,
    Plane,
    PODGalerkin,
    Problem,
    SubspaceNewton,
    Traction,
    box,
    solve,
    symmetries,
)
from dpl.fem.linear.interface import full_matrix

NH = NeoHookeanLn(0.3)
ALONG_X = ConstantFibres([1.0, 0.0, 0.0])
OBLIQUE = ConstantFibres([1.0, 0.6, 0.3])
START = Plane(0, "min")


def first_half(points):
    return points[:, 0] < 0.5


def no_load(problem):
    return Load(torch.zeros(1, *problem.shape, dtype=torch.float64), torch.ones(1))


def swirl(points):
    """Return fibre directions that differ from cell to cell, (E, 3)."""
    x = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    return np.stack([np.cos(x[:, 1]), np.sin(x[:, 0] + x[:, 1]), 0.3 + x[:, 2]], axis=1)


def symmetry_planes(dim):
    """Return supports that allow any stretch along the axes."""
    return [
        DirichletBC(Plane(axis, "min"), [0.0 if i == axis else None for i in range(dim)])
        for axis in range(dim)
    ]


@pytest.fixture
def active(kind, grid, bend):
    """A body of each kind of element with two active parts, and a displacement."""
    cell, degree = kind
    problem = Problem.build(
        grid(cell, 2, 0.15),
        NH,
        fixed=START,
        degree=degree,
        follower_loads=[
            ActiveStress(0.3, directions=FibreFunction(swirl)),
            ActiveStress(0.2, region=first_half, directions=OBLIQUE),
        ],
        length=1.0,
    )
    return problem, bend(problem.points, seed=3)


def test_force_is_the_gradient_of_the_energy(active):
    problem, u = active
    u = u.clone().requires_grad_()
    (slope,) = torch.autograd.grad(problem.follower_loads.work(u).sum(), u)
    assert_close(slope, problem.follower_loads.force(u).detach(), rtol=1e-11, atol=1e-14)
    assert problem.has_potential


def test_tangent_is_the_derivative_of_the_force_and_symmetric(active):
    """By central differences, to 1e-7; from the compiled loops and as tensors."""
    problem, u = active
    v = torch.from_numpy(np.random.default_rng(2).normal(size=u.shape)) * problem.free
    step, loads = 1e-4, problem.follower_loads
    slope = (loads.force(u + step * v) - loads.force(u - step * v)) / (2 * step)
    system = problem.linearise(u)
    elastic = problem.without_follower_loads.linearise(u)
    matrix = full_matrix(problem.pattern, (system.tangent - elastic.tangent)[0].numpy())
    found, expected = matrix @ problem.restrict(v[0]), problem.restrict(slope[0])
    assert np.abs(found - expected).max() < 1e-7 * np.abs(expected).max()
    assert system.skew is None
    assert_close(problem.tangent(u), system.tangent, rtol=1e-10, atol=1e-12)


def test_force_is_affine_and_its_stiffness_constant(active):
    problem, u = active
    loads, rest = problem.follower_loads, torch.zeros_like(u)
    double = loads.force(2 * u) - loads.force(rest)
    assert_close(double, 2 * (loads.force(u) - loads.force(rest)), rtol=1e-12, atol=1e-14)
    added = problem.tangent(u) - problem.without_follower_loads.tangent(u)
    at_rest = problem.tangent(rest)[0] - problem.stiffness_at_rest()
    assert_close(added[0], at_rest, rtol=1e-9, atol=1e-12)
    assert at_rest.abs().max() > 0.01, "K(0) excludes the stiffness of the active stress"


def test_resultant_and_moment_are_zero(active):
    problem, u = active
    force = problem.follower_loads.force(u)[0]
    x, size = problem.points + u[0], force.abs().sum()
    assert force.sum(dim=0).abs().max() < 1e-14 * size
    dipole = x.T @ force
    assert (dipole - dipole.T).abs().max() < 1e-14 * size


@pytest.mark.parametrize("tension", [-0.2, 0.3, 1.5])
@pytest.mark.parametrize("cell", ["quad", "tetra", "hexahedron"])
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
    problem = Problem.build(
        mesh,
        NH,
        supports=symmetry_planes(dim),
        follower_loads=[ActiveStress(tension, directions=ALONG_X)],
        length=1.0,
    )
    found = solve(Newton(problem, tol=1e-12), no_load(problem))
    assert found.converged.all()
    stretches = torch.tensor([a, *[b] * (dim - 1)]).double()
    assert_close(
        problem.points + found.displacement[0], problem.points * stretches, rtol=0, atol=1e-10
    )
    linear = Newton(problem).linear_solver.solve(no_load(problem).force[0])
    shortening = tension * (1 - (NH.poisson**2 if dim == 2 else 0.0))  # Hooke, E = 1
    assert float(linear[:, 0].abs().max()) == pytest.approx(abs(shortening), rel=1e-10)


def test_a_rotated_body_with_rotated_fibres_and_load_has_the_rotated_solution():
    rng = np.random.default_rng(5)
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    Q *= np.linalg.det(Q)
    mesh = box([1.0, 0.5, 0.5], [4, 3, 3])
    fibre, pull = np.array([1.0, 0.5, 0.2]), np.array([0.0, 1e-4, 2e-4])
    fixed = mesh.p[0] < 1e-9

    def answer(rotation):
        problem = Problem.build(
            type(mesh)(rotation @ mesh.p, mesh.t),
            NH,
            fixed=fixed,
            follower_loads=[ActiveStress(0.1, directions=ConstantFibres(rotation @ fibre))],
            length=1.0,
        )
        force = torch.from_numpy(np.tile(rotation @ pull, (problem.shape[0], 1)))[None]
        return solve(Newton(problem, tol=1e-11), Load(force, torch.ones(1))).displacement[0]

    usual, turned = answer(np.eye(3)), answer(Q)
    assert usual.abs().max() > 0.02
    assert_close(turned, usual @ torch.from_numpy(Q.T), rtol=0, atol=1e-9)


@pytest.fixture(scope="module")
def beam():
    def beam(*loads, mean_dilatation=False):
        mesh = box([4.0, 1.0, 1.0], [9, 3, 3])
        return Problem.build(
            mesh, NH, fixed=START, follower_loads=loads, mean_dilatation=mean_dilatation
        )

    return beam


LOWER = Box([-1.0, -1.0, -1.0], [5.0, 2.0, 0.5])


@pytest.mark.parametrize("mean_dilatation", [False, True])
def test_a_muscle_on_one_side_bends_a_beam(beam, mean_dilatation):
    muscle = ActiveStress(0.2, region=LOWER, directions=ALONG_X)
    problem = beam(muscle, mean_dilatation=mean_dilatation)
    found = solve(Newton(problem), no_load(problem))
    assert found.converged.all()
    assert float(found.displacement[0, :, 2].min()) < -0.02
    stepped = solve(Newton(problem, max_iter=3), no_load(problem))
    assert stepped.converged.all()
    assert_close(stepped.displacement, found.displacement, rtol=0, atol=1e-7)


def test_half_the_tension_is_half_the_load_factor(beam):
    whole, half = (beam(ActiveStress(t, directions=OBLIQUE)) for t in (0.2, 0.1))
    found = solve(Newton(whole.with_follower_factor(0.5)), no_load(whole))
    expected = solve(Newton(half), no_load(half))
    assert_close(found.displacement, expected.displacement, rtol=1e-9, atol=1e-12)


def test_residual_is_relative_to_the_active_forces_at_rest(beam):
    for tension in (1e-9, 1e-3):
        problem = beam(ActiveStress(tension, directions=OBLIQUE))
        ratio = problem.relative_residual(no_load(problem).force, no_load(problem).force)
        assert float(ratio) == pytest.approx(1.0, rel=1e-14)


def test_active_stress_pressure_and_dead_load_act_together(beam):
    pressure = FollowerPressure(Plane(2, "max"), 2e-3)
    muscle = ActiveStress(0.05, region=LOWER, directions=ALONG_X)
    problem = beam(muscle, pressure)
    assert not problem.has_potential
    u = torch.from_numpy(np.random.default_rng(0).normal(size=(1, *problem.shape))) * 1e-2
    alone = [beam(one).follower_loads.force(u) for one in (muscle, pressure)]
    assert_close(problem.follower_loads.force(u), sum(alone), rtol=1e-12, atol=1e-16)
    tangents = [beam(*own).tangent(u) for own in ((muscle, pressure), (muscle,), (pressure,), ())]
    both, first, second, none = tangents
    assert_close(both - none, first + second - 2 * none, rtol=1e-9, atol=1e-13)
    force = Traction(Plane(0, "max"), [0.0, 0.0, 1e-3]).on(problem)[None]
    found = solve(Newton(problem), Load(force, torch.ones(1)))
    assert found.converged.all()


def test_gradients_of_solutions_agree_with_differences(beam):
    problem = beam(ActiveStress(0.1, directions=OBLIQUE))
    equilibrium = DifferentiableSolve(Newton(problem, tol=1e-12))
    random = np.random.default_rng(3)
    force = torch.from_numpy(1e-5 * random.normal(size=(1, *problem.shape))) * problem.free
    weights, way = (torch.from_numpy(random.normal(size=force.shape)) for _ in "ab")
    way = 1e-5 * way * problem.free

    def value(f):
        return (weights * equilibrium(Load(f, torch.ones(1)))).sum()

    force.requires_grad_()
    (gradient,) = torch.autograd.grad(value(force), force)
    with torch.no_grad():
        slope = (value(force + 0.01 * way) - value(force - 0.01 * way)) / 0.02
    assert float((gradient * way).sum()) == pytest.approx(float(slope), rel=3e-5)


def test_directions_are_those_of_the_law_unless_given(grid):
    """Of a law with fibres, and of each region of a body of several laws."""
    mesh = grid("hexahedron")
    muscle = FibreReinforced(NH, Guccione(c=0.1, bf=8.0, bt=2.0, bfs=4.0), OBLIQUE)

    def force(law, load):
        return Problem.build(mesh, law, fixed=START, follower_loads=[load]).force_at_rest

    expected = force(NH, ActiveStress(0.3, directions=OBLIQUE))
    assert_close(force(muscle, ActiveStress(0.3)), expected)
    half = {"muscle": first_half}
    several = Heterogeneous({"muscle": muscle, "other": NH}, half)
    expected = force(NH, ActiveStress(0.3, region=first_half, directions=OBLIQUE))
    assert_close(force(several, ActiveStress(0.3, region=first_half)), expected)
    swirling = replace(muscle, directions=FibreFunction(swirl))
    expected = force(NH, ActiveStress(0.3, region=first_half, directions=FibreFunction(swirl)))
    several = Heterogeneous({"other": NH, "muscle": swirling}, half)
    assert_close(force(several, ActiveStress(0.3, region=first_half)), expected)
    with pytest.raises(ValueError, match=r"active_stress: no fibre directions .* in 4 of 8 cells"):
        force(several, ActiveStress(0.3))


def test_active_stress_counts_for_symmetries(grid):
    mesh = grid("hexahedron")
    one, two = (
        Problem.build(
            mesh, NH, fixed=START, follower_loads=[ActiveStress(0.1, directions=directions)]
        )
        for directions in (ALONG_X, ConstantFibres([1.0, 1.0, 0.0]))
    )
    assert len(symmetries(one)) == 8
    assert len(symmetries(two)) == 2


def test_reduced_solvers_refuse_an_active_stress(beam):
    problem = beam(ActiveStress(0.1, directions=ALONG_X))
    with pytest.raises(ValueError, match="has no active stress"):
        PODGalerkin(problem, torch.zeros(*problem.shape, 1).double(), None, None)
    with pytest.raises(ValueError, match="has no active stress"):
        SubspaceNewton(problem, torch.zeros(*problem.shape, 1).double(), None)


@pytest.mark.parametrize(
    ("load", "message"),
    [
        (ActiveStress(0.1), "no fibre directions are known in 8 of 8 cells; set directions"),
        (
            ActiveStress(float("nan"), directions=ALONG_X),
            "value = nan must be a finite number or",
        ),
        (ActiveStress([1.0, 0.0], directions=ALONG_X), r"value = .* low below high"),
        (ActiveStress([1.0, 0.0, 0.0], directions=ALONG_X), r"value = .* along the fibres"),
        (ActiveStress(0.1, region=Box([5, 5, 5], [6, 6, 6])), "holds no cell"),
        (ActiveStress(0.1, directions=ConstantFibres([1.0, 0.0])), "must have 3 components"),
    ],
)
def test_invalid_active_stresses_are_refused_in_one_line(load, message, grid):
    with pytest.raises(ValueError, match=message) as error:
        Problem.build(grid("hexahedron"), NH, follower_loads=[replace(load, name="muscle")])
    assert str(error.value).startswith("follower_loads.muscle: ")
    assert "\n" not in str(error.value)


def test_active_stress_needs_one_modulus(grid):
    muscle = ActiveStress(5.0, directions=ALONG_X)
    with pytest.raises(ValueError, match="young is a range"):
        Problem.build(grid("quad"), NH, follower_loads=[muscle], young=None)
    problem = Problem.build(grid("quad"), NH, follower_loads=[muscle], young=50.0)
    with pytest.raises(ValueError, match="by which the active stress is divided"):
        problem.check_modulus(40.0)

"""Laws of follower pressure: resultants, load stiffness, potential, limits, gradients."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import tril, triu
from torch.testing import assert_close

from benchmarks.verification.pressurised import energy_balance, expanded_radius, expansion, sector
from dpl.fem import (
    DifferentiableSolve,
    DirichletBC,
    FollowerPressure,
    LinearSolver,
    Load,
    NeoHookeanLn,
    Newton,
    Plane,
    PODGalerkin,
    Problem,
    SaintVenantKirchhoff,
    Status,
    Traction,
    box,
    rectangle,
    solve,
    symmetries,
)
from dpl.fem.linear.interface import full_matrix
from dpl.fem.postprocess.energy import RestStiffness, potential_energy

NH = NeoHookeanLn(0.3)
END = Plane(0, "max")


def everywhere(points):
    """Region: all of the boundary."""
    return np.ones(len(points), dtype=bool)


@pytest.fixture
def bodies(kind, grid, bend):
    """Bodies of each kind of element under a pressure, all around and on one side, bent."""
    cell, degree = kind
    mesh = grid(cell, 2, 0.15)
    closed = Problem.build(
        mesh, NH, degree=degree, follower_loads=[FollowerPressure(everywhere, 0.3)], length=1.0
    )
    side = grid(cell, 2)
    opened = Problem.build(
        side,
        NH,
        fixed=Plane(0, "min"),
        degree=degree,
        follower_loads=[FollowerPressure(END, 0.3)],
        length=1.0,
    )
    return {p: bend(p.points, seed=3) for p in (closed, opened)}


def no_load(problem):
    return Load(torch.zeros(1, *problem.shape, dtype=torch.float64), torch.ones(1))


def test_uniform_pressure_on_a_closed_surface_has_no_resultant(bodies):
    problem, u = next(iter(bodies.items()))
    force = problem.follower_loads.force(u)[0]
    x, size = (problem.points + u[0]), force.abs().sum()
    assert force.sum(dim=0).abs().max() < 1e-14 * size
    dipole = x.T @ force  # also without moment: p V times the identity
    assert (dipole - dipole.T).abs().max() < 1e-14 * size


def test_forces_rotate_with_the_body(bodies):
    for problem, u in bodies.items():
        dim = problem.shape[1]
        Q = torch.linalg.qr(torch.from_numpy(np.random.default_rng(1).normal(size=(dim, dim))))[0]
        Q = Q * torch.linalg.det(Q)  # a rotation in 3D; the sign is corrected in 2D below
        if torch.linalg.det(Q) < 0:
            Q = torch.stack([-Q[:, 0], *Q.T[1:]], dim=1)
        turned = ((problem.points + u) @ Q.T) - problem.points
        force = problem.follower_loads.force(u) @ Q.T
        assert_close(problem.follower_loads.force(turned), force, rtol=1e-12, atol=1e-14)


def test_load_stiffness_is_the_derivative_of_the_force(bodies):
    """By central differences, to 1e-7; the tangent holds its symmetric part."""
    for problem, u in bodies.items():
        v = torch.from_numpy(np.random.default_rng(2).normal(size=u.shape)) * problem.free
        step, surface = 1e-4, problem.follower_loads
        slope = (surface.force(u + step * v) - surface.force(u - step * v)) / (2 * step)
        system = problem.linearise(u)
        elastic = problem.without_follower_loads.linearise(u)
        added = (system.tangent - elastic.tangent)[0].numpy()
        matrix = full_matrix(problem.pattern, added)
        if system.skew is not None:
            skew = full_matrix(problem.pattern, system.skew[0].numpy())
            matrix = matrix + triu(skew) - tril(skew)
        found = matrix @ problem.restrict(v[0])
        expected = problem.restrict(slope[0])
        assert np.abs(found - expected).max() < 1e-7 * np.abs(expected).max()
        assert_close(problem.tangent(u), system.tangent, rtol=1e-10, atol=1e-12)


def test_force_is_the_gradient_of_the_work_if_there_is_a_potential(bodies):
    closed, opened = bodies
    assert closed.has_potential
    assert not opened.has_potential
    u = bodies[closed].requires_grad_()
    (slope,) = torch.autograd.grad(closed.energy(u).sum(), u)
    assert_close(slope, closed.internal_force(u).detach(), rtol=1e-10, atol=1e-13)


def test_potential_exists_where_the_edge_is_fixed_or_slides_in_a_plane(grid):
    mesh = grid("hexahedron")
    top = FollowerPressure(Plane(2, "max"), 0.1)
    sides = [
        DirichletBC(Plane(axis, at), [0.0 if i == axis else None for i in range(3)])
        for axis in (0, 1)
        for at in ("min", "max")
    ]
    bottom = Plane(2, "min")
    assert Problem.build(mesh, NH, fixed=bottom, supports=sides, follower_loads=[top]).has_potential
    assert not Problem.build(
        mesh, NH, fixed=bottom, supports=sides[:3], follower_loads=[top]
    ).has_potential


def test_work_is_pressure_times_volume(grid):
    """A cube of side 1 under pressure that grows to side 1.2."""
    problem = Problem.build(
        grid("tetra"), NH, follower_loads=[FollowerPressure(everywhere, 0.3)], length=1.0
    )
    u = 0.2 * problem.points[None]
    assert float(problem.follower_loads.work(u)) == pytest.approx(0.3 * (1.2**3 - 1), rel=1e-13)


def test_small_pressure_acts_as_a_dead_load_on_the_surface_at_rest(kind, grid):
    """The linear solutions agree to rounding, Newton's to the order of the pressure."""
    cell, degree = kind
    p, mesh = 1e-6, grid(cell, 2)
    dead = Problem.build(mesh, NH, fixed=Plane(0, "min"), degree=degree, length=1.0)
    problem = Problem.build(
        mesh, NH, fixed=Plane(0, "min"), degree=degree, length=1.0,
        follower_loads=[FollowerPressure(END, p)],
    )  # fmt: skip
    value = [-p] + [0.0] * (mesh.dim() - 1)
    force = Traction(END, value).on(dead)
    linear = solve(LinearSolver(problem), no_load(problem)).displacement
    assert_close(linear[0], LinearSolver(dead).solve(force), rtol=1e-10, atol=1e-18)
    found = solve(Newton(problem), no_load(problem))
    assert found.converged.all()
    assert (found.displacement - linear).norm() < 1e-5 * linear.norm()


@pytest.fixture
def beam_under_pressure():
    """Beam whose upper side is under a pressure without potential."""

    def build(p, law=NH):
        mesh = box([4.0, 1.0, 1.0], [9, 3, 3])
        return Problem.build(
            mesh, law, fixed=Plane(0, "min"), follower_loads=[FollowerPressure(Plane(2, "max"), p)]
        )

    return build


@pytest.mark.parametrize("mixed", [False, True], ids=["plain", "mixed"])
def test_newton_converges_quadratically_without_a_potential(beam_under_pressure, mixed):
    problem = beam_under_pressure(2e-3)
    newton = Newton(problem, tol=1e-12, mixed_integration=mixed)
    residuals = [float(s.residual) for s in newton.iterate(no_load(problem))]
    assert residuals[-1] < 1e-12
    assert residuals[0] == 1.0
    assert len(residuals) <= 8
    before, last = residuals[-3:-1]
    assert last < 0.1 * before


def test_load_steps_and_the_corotated_factor_lead_to_the_same_solution(beam_under_pressure):
    problem = beam_under_pressure(1e-2)
    solver = Newton(problem, linear="superlu")
    found = solve(solver, no_load(problem))
    assert found.converged.all()
    assert float(found.displacement.abs().max()) > 0.4
    stepped = replace(solver, max_iter=4)
    corotated = replace(solver, corotational=True, factor_reuse_tol=1.0)
    for other in (stepped, corotated):
        answer = solve(other, no_load(problem))
        assert answer.converged.all()
        assert_close(answer.displacement, found.displacement, rtol=0.0, atol=1e-7)


def test_half_the_pressure_is_half_the_load_factor(beam_under_pressure):
    whole, half = beam_under_pressure(4e-3), beam_under_pressure(2e-3)
    found = solve(Newton(whole.with_follower_factor(0.5)), no_load(whole))
    expected = solve(Newton(half), no_load(half))
    assert_close(found.displacement, expected.displacement, rtol=1e-9, atol=1e-12)


def test_dead_load_and_pressure_act_together(beam_under_pressure):
    problem = beam_under_pressure(2e-3)
    force = Traction(END, [0.0, 0.0, 4e-3]).on(problem)[None]
    found = solve(Newton(problem), Load(force, torch.ones(1)))
    assert found.converged.all()
    residual = problem.residual(found.displacement, force)
    assert residual.norm() < 1e-8 * problem.acting(force).norm()


def test_residual_is_relative_to_the_pressure_at_rest(beam_under_pressure):
    """With no other force ||R||/||f|| is 1 at rest and does not depend on the unit of pressure."""
    for p in (1e-9, 1e-3):
        problem = beam_under_pressure(p)
        ratio = problem.relative_residual(
            torch.zeros(1, *problem.shape).double(), no_load(problem).force
        )
        assert float(ratio) == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize("p", [2e-3, 1e-2])
def test_gradients_of_solutions_without_potential_agree_with_differences(beam_under_pressure, p):
    problem = beam_under_pressure(p)
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


def test_pressure_beyond_the_limit_point_has_no_valid_equilibrium():
    """A neo-Hookean sphere or cylinder has a largest internal pressure."""
    mesh = sector(2, 2, "quad", quadratic=True)
    with pytest.raises(AssertionError, match="no valid equilibrium"):
        expansion(0.3, 0.6, mesh, 2)


def test_nothing_changes_without_pressure(grid):
    problem = Problem.build(grid("hexahedron"), NH, fixed=Plane(0, "min"))
    assert not problem.follower_loads
    assert problem.with_follower_factor(0.5) is problem
    assert problem.without_follower_loads is problem
    assert problem.has_potential
    assert not problem.force_at_rest.any()


def test_pressure_counts_for_symmetries(grid):
    mesh = grid("hexahedron")
    clamped = {"fixed": Plane(0, "min")}
    assert len(symmetries(Problem.build(mesh, NH, **clamped))) == 8
    one_side = Problem.build(
        mesh, NH, **clamped, follower_loads=[FollowerPressure(Plane(2, "max"), 0.1)]
    )
    around = Problem.build(mesh, NH, **clamped, follower_loads=[FollowerPressure(END, 0.1)])
    assert len(symmetries(one_side)) == 2
    assert len(symmetries(around)) == 8


def test_pressures_add_up(grid):
    mesh = grid("quad")
    regions = [Plane(0, "max"), Plane(1, "max"), Plane(0, "max")]
    several = Problem.build(
        mesh,
        NH,
        follower_loads=[FollowerPressure(r, v) for r, v in zip(regions, (1, 2, 3), strict=True)],
    )
    force = several.force_at_rest.sum(dim=0)
    assert_close(force, torch.tensor([4.0, 2.0], dtype=torch.float64))


@pytest.mark.parametrize("value", [float("nan"), [1.0, 0.0], True, "soft"])
def test_invalid_pressures_are_refused(value, grid):
    with pytest.raises(ValueError, match=r"value = .* must be"):
        Problem.build(grid("quad"), NH, follower_loads=[FollowerPressure(END, value)])


def test_pressure_needs_one_modulus(grid):
    with pytest.raises(ValueError, match="young is a range"):
        Problem.build(grid("quad"), NH, follower_loads=[FollowerPressure(END, 1.0)], young=None)
    problem = Problem.build(
        grid("quad"), NH, follower_loads=[FollowerPressure(END, 5.0)], young=50.0
    )
    assert_close(problem.force_at_rest.sum(dim=0)[0].item(), 0.1)
    with pytest.raises(ValueError, match="by which the follower pressure is divided"):
        problem.check_modulus(40.0)


def test_reduced_solvers_refuse_a_pressure(beam_under_pressure):
    problem = beam_under_pressure(1e-3)
    with pytest.raises(ValueError, match="has no follower pressure"):
        PODGalerkin(problem, torch.zeros(*problem.shape, 1).double(), None, None)


def test_potential_energy_needs_a_potential(beam_under_pressure):
    problem = beam_under_pressure(1e-3)
    load = no_load(problem)
    with pytest.raises(ValueError, match="has no potential"):
        potential_energy(load.force, load, problem, RestStiffness(problem))


@pytest.mark.parametrize("nu", [0.3, 0.49])
def test_thick_cylinder_expands_as_the_radial_solution(nu):
    """Quadratic quadrilaterals: order 4, and 1e-6 on 8 cells."""
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


def test_pressure_on_a_strip_in_the_plane(grid):
    """2D: a strip clamped on one end, under pressure on the upper side, rolls up."""
    mesh = rectangle([5.0, 1.0], [21, 5], "quad")
    problem = Problem.build(
        mesh, SaintVenantKirchhoff(0.3), fixed=Plane(0, "min"),
        follower_loads=[FollowerPressure(Plane(1, "max"), 1e-3)],
    )  # fmt: skip
    found = solve(Newton(problem), no_load(problem))
    assert int(found.status) == Status.CONVERGED
    assert float(found.displacement[0, :, 1].min()) < -0.1

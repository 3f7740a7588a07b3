"""Laws of the corotational preconditioner, and of Newton with it."""

import math
from dataclasses import replace
from multiprocessing.reduction import ForkingPickler

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from solving import load_of, rest

from dpl import fem

NH, SVK = fem.NeoHookeanLn(0.3), fem.SaintVenantKirchhoff(0.3)


def body(dim=3, law=NH, degree=1, **more):
    """Return a slender clamped body, four times as long as high."""
    mesh = fem.box([4.0, 1.0, 1.0], [9, 3, 3]) if dim == 3 else fem.rectangle([4.0, 1.0], [13, 4])
    return fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"), degree=degree, **more)


def bend(problem, total):
    """Return a load across the far end, `total` over E L^2."""
    direction = torch.zeros(problem.shape[1])
    direction[-1] = -total * 16
    force = fem.Traction(fem.Plane(0, "max"), direction.tolist()).on(problem)
    return load_of(force[None])


@pytest.mark.parametrize(
    ("dim", "degree", "angle", "stretches"),
    [
        (2, 1, 3.0, (20, 0.05)),
        (2, 2, 1e-3, (1.3, 0.8)),
        (3, 1, 1e-3, (1.3, 0.8, 1.1)),
        (3, 2, 3.0, (20, 0.05, 3)),
    ],
)
def test_nodes_are_rotated_by_the_rotation_of_their_gradient(dim, degree, angle, stretches):
    problem = body(dim, degree=degree)
    axis = np.array([1.0, 2.0, 3.0]) / math.sqrt(14)
    if dim == 3:
        turn = Rotation.from_rotvec(angle * axis).as_matrix()
    else:
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    stretch = np.diag(stretches[:dim])
    u = problem.points @ torch.from_numpy(turn @ stretch - np.eye(dim)).T
    rotated = fem.LinearSolver(problem).corotational.at(u[None])
    whole = problem.free.all(dim=1).numpy()
    assert np.allclose(rotated.rotations[whole, :dim, :dim], turn, atol=1e-8)
    assert (rotated.rotations[~whole] == np.eye(3)).all()
    assert (rotated.rotations[:, dim:] == np.eye(3)[dim:]).all()


def test_a_node_fixed_in_one_direction_is_rotated_about_it():
    for axis in range(3):
        sides = [0.0 if i == axis else None for i in range(3)]
        problem = body(supports=[fem.DirichletBC(fem.Plane(1, "min"), sides)])
        turn = Rotation.from_rotvec(0.7 * np.eye(3)[axis]).as_matrix()
        u = problem.points @ torch.from_numpy(turn - np.eye(3)).T
        rotated = fem.LinearSolver(problem).corotational.at(u[None])
        partly = (problem.free.sum(dim=1) == 2).numpy()
        assert partly.sum() > 10
        assert np.allclose(rotated.rotations[partly], turn, atol=1e-8)


def test_nodes_fixed_in_two_directions_or_of_an_inverted_body_are_not_rotated():
    problem = body(supports=[fem.DirichletBC(fem.Plane(1, "min"), [0.0, 0.0, None])])
    turn = Rotation.from_rotvec([0.2, 0.3, 0.4]).as_matrix()
    preconditioner = fem.LinearSolver(problem).corotational
    found = preconditioner.at((problem.points @ torch.from_numpy(turn - np.eye(3)).T)[None])
    fixed = (problem.free.sum(dim=1) < 2).numpy()
    assert (found.rotations[fixed] == np.eye(3)).all()
    assert (preconditioner.at(-2.0 * problem.points[None]).rotations == np.eye(3)).all()


def test_at_rest_the_preconditioner_is_the_inverse_of_the_stiffness():
    problem = body()
    linear = fem.LinearSolver(problem)
    zero = rest(problem)
    right = np.random.default_rng(0).standard_normal(problem.pattern.size)
    ours, exact = linear.corotational.at(zero).apply(right), linear.factor.solve(right)
    assert np.linalg.norm(ours - exact) < 1e-4 * np.linalg.norm(exact)
    assert linear.count_iterations(zero) == 1


@pytest.mark.parametrize(("dim", "backend"), [(2, "superlu"), (3, "auto")])
def test_the_preconditioner_is_symmetric_and_positive_definite(dim, backend):
    problem = body(dim)
    random = np.random.default_rng(1)
    u = torch.from_numpy(0.02 * random.standard_normal((1, *problem.shape)))
    rotated = fem.LinearSolver(problem, linear=backend).corotational.at(u)
    for _ in range(5):
        x, y = random.standard_normal((2, problem.pattern.size))
        size = np.linalg.norm(x) * np.linalg.norm(rotated.apply(y))
        assert abs(y @ rotated.apply(x) - x @ rotated.apply(y)) < 1e-5 * size
        assert x @ rotated.apply(x) > 0


@pytest.mark.parametrize(
    ("mixed", "options"),
    [
        (False, {}),
        (True, {"law": SVK}),
        (False, {"dim": 2, "degree": 2}),
        (False, {"mean_dilatation": True}),
        (True, {"law": fem.NeoHookeanLn(0.49), "mean_dilatation": True}),
        (True, {"supports": [fem.DirichletBC(fem.Plane(0, "max"), [0.0, 0.0, -0.6])]}),
    ],
    ids=str,
)
def test_newton_has_the_same_solution_with_the_preconditioner(options, mixed):
    problem = body(**options)
    load = bend(problem, 1e-4 if problem.shape[1] == 3 else 5e-4)
    plain = fem.Newton(problem, mixed_integration=mixed)
    ours, theirs = fem.solve(replace(plain, corotational=True), load), fem.solve(plain, load)
    assert theirs.displacement.norm(dim=-1).max() > 0.09, "or it would prove nothing"
    assert ours.converged.all()
    assert (ours.residual < 1e-8).all()
    assert torch.allclose(ours.displacement, theirs.displacement, rtol=0, atol=1e-8)
    assert (ours.factorisations < theirs.factorisations).all()


def test_rotation_halves_the_iterations_far_from_rest(monkeypatch):
    problem = body()
    answer = fem.solve(fem.Newton(problem), bend(problem, 4e-4)).displacement
    linear = fem.LinearSolver(problem)
    rotated = linear.count_iterations(answer)
    monkeypatch.setattr(type(linear.corotational), "at", lambda self, u: self.factor)
    assert rotated <= 8
    assert linear.count_iterations(answer) > 2 * rotated


def test_a_tangent_is_factorised_where_the_preconditioner_is_poor():
    """In a plate of thickness 1/100 the errors of the rotations cause large strains."""
    problem = fem.Problem.build(
        fem.box([1.0, 0.2, 0.01], [17, 5, 2]), NH, fixed=fem.Plane(0, "min")
    )
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -1e-3]).on(problem)
    load = load_of(force[None])
    plain = fem.Newton(problem)
    ours, theirs = fem.solve(replace(plain, corotational=True), load), fem.solve(plain, load)
    assert ours.factorisations.all()
    assert ours.converged.all()
    assert torch.allclose(ours.displacement, theirs.displacement, rtol=0, atol=1e-8)


def test_stability_is_unknown_without_a_factor():
    problem = body()
    load = bend(problem, 2e-4)
    plain = fem.Newton(problem)
    ours, theirs = fem.solve(replace(plain, corotational=True), load), fem.solve(plain, load)
    assert not ours.factorisations.any()
    assert ours.negative_pivots.tolist() == [-1]
    assert theirs.negative_pivots.tolist() == [0]
    assert ours.status.tolist() == [int(fem.Status.CONVERGED)]


def test_the_linear_solver_is_kept_unless_backend_or_body_are_replaced():
    newton = fem.Newton(body())
    other = replace(newton, tol=1e-3, corotational=True)
    assert (other.tol, other.corotational) == (1e-3, True)
    assert other.linear_solver is newton.linear_solver
    for other in (replace(newton, linear="superlu"), replace(newton, problem=body(law=SVK))):
        assert other.linear_solver is not newton.linear_solver
        assert other.linear_solver.problem is other.problem
        assert other.linear_solver.linear == other.linear


def test_rotations_do_not_depend_on_the_memory_of_the_problem():
    """Sending a problem to a process moves its tensors, so compiled loops read copies."""
    problem = body()
    preconditioner = fem.Newton(problem).linear_solver.corotational
    u = 0.1 * problem.points.roll(1, dims=1)[None] * problem.free
    before = preconditioner.at(u).rotations.copy()
    kept = preconditioner._arrays[2]
    assert kept.ctypes.data != problem.cells.data_ptr()
    ForkingPickler.dumps(problem)
    assert np.array_equal(preconditioner.at(u).rotations, before)

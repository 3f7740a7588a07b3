"""Factors of K(0) by parity: they solve like the factor of the whole matrix and are smaller."""

import pickle

import numpy as np
import pytest
import torch
from scipy.linalg import norm

from dpl import fem
from dpl.fem.linear.banded import BandedFactor
from dpl.fem.solvers.parity_factor import ParityFactor

NH = fem.NeoHookeanLn(0.3)
LEFT = fem.Plane(0, "min")
BODIES = {
    "beam with a square section": (fem.box([4.0, 1.0, 1.0], [9, 4, 4]), {}, 4),
    "beam with a rectangular section": (fem.box([4.0, 2.0, 1.0], [9, 4, 3]), {}, 4),
    "quadratic beam": (fem.box([4.0, 1.0, 1.0], [4, 3, 3]), {"degree": 2}, 4),
    "plate": (fem.rectangle([4.0, 1.0], [13, 9]), {}, 2),
    "beam on a foundation": (
        fem.box([4.0, 1.0, 1.0], [9, 4, 4]),
        {"supports": [fem.DirichletBC(LEFT), fem.RobinBC(fem.Plane(2, "min"), 0.1)]},
        2,
    ),
}


@pytest.fixture(params=BODIES, scope="module")
def body(request):
    """Return the linear solver of a symmetric body, and the number of its reflections."""
    mesh, options, count = BODIES[request.param]
    options = {"supports": [fem.DirichletBC(LEFT)], **options}
    return fem.LinearSolver(fem.Problem.build(mesh, NH, **options), linear="band"), count


def test_the_factor_by_parity_solves_like_the_whole_with_one_unknown_for_each_orbit(body):
    """For right-hand sides of very different magnitudes."""
    solver, count = body
    right = np.random.default_rng(0).standard_normal((4, solver.problem.pattern.size))
    right *= np.array([[1.0], [1e-60], [1e60], [0.0]])
    factor, exact = solver.float32_factor, solver.factor.solve_many(right)
    assert isinstance(factor, ParityFactor)
    assert (norm(factor.solve_many(right) - exact, axis=1) <= 5e-5 * norm(exact, axis=1)).all()
    assert len(factor.inverse.blocks.values) == count
    assert factor.orbits.dofs.shape[1] < 0.75 * solver.problem.pattern.size


def test_entries_of_the_inverse_are_those_of_solutions(body):
    """In short steps: of the forward pass of the parities, of blocks of solutions elsewhere."""
    solver, _ = body
    size = solver.problem.pattern.size
    places = np.random.default_rng(0).choice(size, 40, replace=False)
    exact = solver.factor.solve_many(np.eye(size)[places])[:, places]
    for factor in (solver.float32_factor, solver.factor):
        found = np.zeros((40, 40))
        steps = sum(1 for _ in factor.compliance_steps(places, found, size, 1e-9))
        assert steps > 4
        assert norm(found - exact) < 1e-5 * norm(exact)


def test_a_body_without_reflections_has_one_parity():
    mesh = fem.box([4.0, 1.0, 1.0], [9, 3, 3])
    x, y, z = mesh.p
    crooked = type(mesh)(np.array([x, y + 0.1 * x**2, z + 0.2 * x]), mesh.t)
    solver = fem.LinearSolver(fem.Problem.build(crooked, NH, fixed=LEFT), linear="band")
    right = np.random.default_rng(0).standard_normal(solver.problem.pattern.size)
    factor, exact = solver.float32_factor, solver.factor.solve(right)
    assert isinstance(factor, ParityFactor)
    assert len(factor.orbits.characters) == 1
    assert norm(factor.solve(right) - exact) < 1e-5 * norm(exact)


@pytest.mark.parametrize(("ends", "kind"), [((0.2, 0.4), ParityFactor), ((0, 0.49), BandedFactor)])
def test_other_parameters_have_interpolated_blocks_or_bands(ends, kind):
    """Bands serve ranges that are too wide; the reference has blocks of its own there."""
    problem = fem.Problem.build(
        fem.box([4.0, 1.0, 1.0], [9, 4, 4]), fem.NeoHookeanLn(list(ends)), fixed=LEFT
    )
    solver = fem.LinearSolver(problem, linear="band")
    clone = solver.with_parameters(torch.tensor([[0.25]], dtype=torch.float64))
    right = np.random.default_rng(0).standard_normal(problem.pattern.size)
    for one, own in ((solver.reference, ParityFactor), (clone, kind)):
        exact = one.factor.solve(right)
        assert isinstance(one.float32_factor, own)
        assert norm(one.float32_factor.solve(right) - exact) < 1e-4 * norm(exact)


def test_a_copy_for_a_worker_has_the_blocks():
    problem = fem.Problem.build(fem.box([4.0, 1.0, 1.0], [9, 4, 4]), NH, fixed=LEFT)
    solver = fem.LinearSolver(problem, linear="band")
    blocks = solver.condensed.blocks
    copy = pickle.loads(pickle.dumps(solver))
    assert np.array_equal(vars(copy.condensed)["blocks"].values, blocks.values)

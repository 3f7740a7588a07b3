"""Laws of the linear solution with finite rotations."""

import pytest
import torch

from dpl.fem import Load, NeoHookeanLn, Newton, Plane, Problem, box, rectangle, solve
from dpl.fem.solvers.rotation_strain import warped_solution

BODIES = {
    "hexahedra": (box([8.0, 1.0, 1.0], [25, 4, 4]), 1, 0.3),
    "quadratic tetrahedra": (box([8.0, 1.0, 1.0], [13, 3, 3], "tetra"), 2, 0.45),
    "triangles in the plane": (rectangle([8.0, 1.0], [33, 5], "triangle"), 1, 0.3),
}


def size(field):
    return float(field.norm())


@pytest.fixture(params=BODIES)
def cantilever(request):
    """A solver, and a force at the free end with a linear deflection of 0.3 L."""
    mesh, degree, poisson = BODIES[request.param]
    problem = Problem.build(mesh, NeoHookeanLn(poisson), fixed=Plane(0, "min"), degree=degree)
    newton = Newton(problem, linear="superlu")
    force = torch.zeros(problem.shape, dtype=torch.float64)
    force[problem.points[:, 0] == problem.points[:, 0].max(), -1] = 1.0
    deflection = newton.linear_solver.solve(force).norm(dim=1).max()
    return newton, 0.3 / deflection * force


def test_a_bent_body_is_nearer_to_its_equilibrium_than_in_the_linear_theory(cantilever):
    newton, force = cantilever
    load = Load(force[None], torch.ones(1).double())
    warped = warped_solution(newton.linear_solver, load)
    exact, linear = (solve(one, load).displacement for one in (newton, newton.linear_solver))
    assert size(warped - exact) < 0.4 * size(linear - exact)
    assert newton.problem.volume_ratio(warped) > 0.8


def test_the_change_of_the_linear_solution_is_of_second_order_in_the_load(cantilever):
    newton, force = cantilever
    changes = []
    for factor in (1e-4, 2e-4):
        load = Load(factor * force[None], torch.ones(1).double())
        linear = solve(newton.linear_solver, load).displacement
        changes.append(size(warped_solution(newton.linear_solver, load) - linear))
    assert changes[1] / changes[0] == pytest.approx(4, rel=0.02)

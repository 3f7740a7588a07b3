"""Laws of spread loads: they add up to what acts, wherever the nodes lie."""

import math

import numpy as np
import pytest
import torch
from solving import bar
from torch.testing import assert_close

from dpl import fem
from dpl.fem.loads import body_force, traction


@pytest.fixture
def body(kind, grid) -> fem.Problem:
    """A unit body of each kind of element, shaken inside, in units of four times its side."""
    cell, degree = kind
    mesh = grid(cell, 3, 0.15, inside=True)
    return fem.Problem.build(mesh, fem.NeoHookeanLn(0.3), degree=degree, length=4.0)


def test_constant_traction_adds_up_to_stress_times_area_in_the_middle_of_its_face(body):
    """In units of E L^2; no node off the face is loaded."""
    dim, side = body.shape[1], 1 / body.length
    stress = [0.3, -2.0, 0.7][:dim]
    force = fem.Traction(fem.Plane(0, "max"), stress).on(body)
    total = torch.tensor(stress, dtype=torch.float64) * side ** (dim - 1)
    assert_close(force.sum(dim=0), total, rtol=1e-12, atol=1e-14)
    assert force[body.points[:, 0] < side - 1e-9].abs().max() < 1e-15
    middle = torch.tensor([side, side / 2, side / 2], dtype=torch.float64)[:dim]
    dipole = body.points.T @ force
    assert_close(dipole, torch.outer(middle, total), rtol=1e-12, atol=1e-14)


def test_linear_traction_adds_up_to_its_integral(body):
    """The stress (y, 0, 0) on a face of side s: total s^2 / 2 times s^(D - 2)."""
    dim, side = body.shape[1], 1 / body.length

    def stress(x):
        return np.stack([x[1], *[0 * x[1]] * (dim - 1)])

    force = traction(body, fem.Plane(0, "min"), stress).sum(dim=0)
    assert force[0].item() == pytest.approx(side**2 / 2 * side ** (dim - 2), rel=1e-12)
    assert not force[1:].any()


def test_body_force_is_evaluated_where_it_acts(kind, grid):
    """The total of the density (x, 0, 0) over a unit body is 1/2."""
    cell, degree = kind
    problem = fem.Problem.build(grid(cell, 3), fem.NeoHookeanLn(0.3), degree=degree, length=1.0)

    def density(x):
        return np.stack([x[0], *[0 * x[0]] * (len(x) - 1)])

    force = body_force(problem, density).sum(dim=0)
    assert force[0].item() == pytest.approx(0.5, rel=1e-12)
    assert not force[1:].any()


def test_body_force_is_a_weight_per_volume_over_young(body):
    """The force over E L^2 of a density [1/m] on a volume of 1 m^D."""
    value = [0.3, -2.0, 0.7][: body.shape[1]]
    force = fem.BodyForce(value).on(body)
    expected = [density / body.length ** (body.shape[1] - 1) for density in value]
    assert force.sum(dim=0).tolist() == pytest.approx(expected, rel=1e-12)


def test_region_of_a_traction_is_in_metres(body):
    value = [1.0] * body.shape[1]
    force = fem.Traction(fem.Plane(1, 1.0), value).on(body)
    expected = [one / body.length ** (body.shape[1] - 1) for one in value]
    assert force.sum(dim=0).tolist() == pytest.approx(expected, rel=1e-12)
    with pytest.raises(ValueError, match="no facet of the boundary"):
        fem.Traction(fem.Plane(1, 1.234), value).on(body)


@pytest.mark.parametrize(
    ("cell", "value"),
    [
        *(("hexahedron", value) for value in ([], [1.0], [1.0] * 4, [1.0, math.nan, 0.0])),
        *(("hexahedron", [math.inf] * 3), ("quad", [0.0, 0.0, -1.0])),
    ],
)
def test_load_of_the_wrong_length_is_an_error(grid, cell, value):
    problem = fem.Problem.build(grid(cell), fem.NeoHookeanLn(0.3))
    for load in (fem.Traction(fem.Plane(0, "max"), value), fem.BodyForce(value)):
        with pytest.raises(ValueError, match=f"must be {problem.shape[1]} finite numbers"):
            load.on(problem)


def test_bar_hanging_in_its_own_weight_stretches_quadratically(kind):
    """With nu = 0 its end moves along by rho h^2 / 2, exactly at the nodes of bars in a row."""
    cell, degree = kind
    if degree == 1 and cell in ("triangle", "tetra"):
        pytest.skip("cells that are no bars")
    mesh = bar(cell, 4)
    problem = fem.Problem.build(
        mesh, fem.LinearElastic(0.0), fixed=fem.Plane(0, "min"), degree=degree
    )
    force = fem.BodyForce([1e-3, *[0.0] * (mesh.dim() - 1)]).on(problem)
    u = fem.LinearSolver(problem, linear="superlu").solve(force) * problem.length
    x = problem.points[:, 0] * problem.length
    expected = 1e-3 * x * (8 - x) / 2
    assert_close(u[:, 0], expected, rtol=0, atol=1e-13)
    assert u[:, 1:].abs().max() < 1e-13

"""Bodies far from the origin give the same results as near it.

Coordinates at a distance of d lack eps * d of their digits, which is eps * d / h of a cell of size
h. Results may differ by a small multiple of this, and nothing may differ by more.
"""

import numpy as np
import pytest
import skfem
import torch
from torch.testing import assert_close

from dpl import fem
from dpl.fem.loads import body_force, traction

NH, EPS = fem.NeoHookeanLn(0.3), np.finfo(float).eps
CELLS = 3  # along the sides of the grids
DISTANCE = 1e6  # of a body, in lengths


def away(mesh: skfem.Mesh, distance: float) -> skfem.Mesh:
    """Return the mesh that far away, in no special direction."""
    return mesh.translated(distance * np.array([1.0, -0.7, 0.9])[: mesh.dim()])


def test_a_body_about_the_origin_is_not_moved(beam):
    problem = beam(NH)
    assert not problem.origin.any()
    assert np.array_equal(problem.mesh.p, fem.box([100.0, 25.0, 25.0], [9, 3, 3]).p / 100.0)


def test_a_far_body_is_written_at_its_coordinates(kind, grid):
    mesh = away(grid(kind[0], CELLS, 0.15), DISTANCE)
    problem = fem.Problem.build(mesh, NH, degree=kind[1])
    assert np.abs(problem.points.numpy()).max() < 3
    assert problem.mesh_in_metres.p == pytest.approx(mesh.p, abs=2 * EPS * DISTANCE)


def test_loads_and_springs_on_a_far_body_are_those_on_a_near_one(kind, grid):
    """Hexahedra ask for the reference points of facets, which Newton's method finds."""
    values = []
    for d in (0.0, DISTANCE):
        mesh = away(grid(kind[0], CELLS, 0.15, inside=True), d)
        problem = fem.Problem.build(
            mesh, NH, degree=kind[1], supports=[fem.RobinBC(fem.Plane(0, "min"), 0.3)]
        )
        dim = problem.shape[1]
        stress = fem.Traction(fem.Plane(0, "max"), [0.3, -2.0, 0.7][:dim]).on(problem)
        values.append((stress, fem.BodyForce([0.3, -2.0, 0.7][:dim]).on(problem)))
        pull = problem.springs.force(torch.ones(1, *problem.shape, dtype=torch.float64))
        values[-1] += (pull,)
    tolerance = 100 * EPS * DISTANCE * CELLS  # a hundred times what the digits of coordinates lack
    for near, far in zip(*values, strict=True):
        assert_close(far, near, rtol=0.0, atol=tolerance * float(near.abs().max()))


def test_fields_of_loads_receive_the_coordinates_of_the_user(grid):
    mesh = away(grid("hexahedron", CELLS), DISTANCE)
    problem = fem.Problem.build(mesh, NH, length=1.0)
    low, high = mesh.p.min(axis=1), mesh.p.max(axis=1)

    def seen(x):
        assert (x >= low[:, None, None] - 4 * EPS * DISTANCE).all()
        assert (x <= high[:, None, None] + 4 * EPS * DISTANCE).all()
        return np.zeros_like(x)

    body_force(problem, seen)
    traction(problem, fem.Plane(0, "max"), seen)


def test_regions_in_absolute_coordinates_hold_the_same_nodes():
    """The corners of a box, a ball and a cylinder lie on nodes, where rounding decides."""
    near = fem.box([4.0, 1.0, 1.0], [9, 5, 5])
    mesh = away(near, 4 * DISTANCE)
    shift = mesh.p[:, 0] - near.p[:, 0]
    for region in (
        lambda at: fem.Plane(0, at[0] + 0.5),
        lambda at: fem.Box(at, at + np.array([1.0, 0.5, 1.0])),
        lambda at: fem.Sphere(at, 0.5),
        lambda at: fem.Cylinder(0, 0.25, at),
    ):
        held = [
            ~fem.Problem.build(m, NH, supports=[fem.DirichletBC(region(at))]).free
            for m, at in ((near, np.zeros(3)), (mesh, shift))
        ]
        assert held[0].any()
        assert torch.equal(*held)


def test_a_body_a_thousand_lengths_away_keeps_its_symmetries():
    problem = fem.Problem.build(
        away(fem.box([4.0, 1.0, 1.0], [5, 3, 3]), 4e3), NH, fixed=fem.Plane(0, "min")
    )
    assert len(fem.symmetries(problem)) == 8

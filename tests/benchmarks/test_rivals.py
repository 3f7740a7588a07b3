"""Regressions of other packages behind the interface of this package's networks."""

import numpy as np
import pytest

import dpl.fem as fem
from benchmarks.rivals import BASES, InCoordinates, linear_solution, measured
from benchmarks.samples import solved
from dpl.scene import Scene


def least_squares(X, Y, held, seconds):
    """A regression that is exact where outputs are linear in inputs."""
    matrix = np.linalg.lstsq(X, Y, rcond=None)[0]
    return (lambda x: x @ matrix), matrix.size


@pytest.fixture(scope="module")
def scene():
    mesh = fem.box(size=(0.5, 0.2, 0.2), nodes=(5, 3, 3))
    problem = fem.Problem.build(mesh, fem.LinearElastic(poisson=0.3), fixed=fem.Plane(0, 0.0))
    solver = fem.Newton(problem, 1e-9)
    return Scene(problem, fem.GravityLoads(solver.linear_solver, young=1e6), solver)


def test_a_linear_body_is_learnt_exactly_by_linear_regression(scene):
    train, test = (solved(scene, scene.loads.sample(k, range(n))) for k, n in ((0, 40), (1, 5)))
    sets = {"in range": test, "small": test, "twice": test}
    net = InCoordinates(least_squares)
    predictor = BASES["plain"](net, scene)
    net.learn_from(predictor, (train, test), 0.0)
    row = measured(("least squares", "plain", predictor, 0.0, net.weights), 40, sets)
    assert row.worst < 1e-4  # fields are rounded to float32
    assert measured(linear_solution(scene), 0, sets).worst < 1e-5

"""Methods of other packages behind the interface of this package's networks."""

from functools import partial

import numpy as np
import pytest
import torch
from torch import nn

import dpl.fem as fem
from benchmarks.rival_methods import InCoordinates, OnNodes
from benchmarks.rivals import BASES, linear_solution, measured
from benchmarks.samples import solved
from dpl.scene import Scene


def least_squares(X, Y, held, train):
    """A regression that is exact where outputs are linear in inputs."""
    matrix = np.linalg.lstsq(X, Y, rcond=None)[0]
    return (lambda x: x @ matrix), matrix.size


@pytest.fixture(scope="module")
def scene():
    mesh = fem.box(size=(0.5, 0.2, 0.2), nodes=(5, 3, 3))
    problem = fem.Problem.build(mesh, fem.LinearElastic(poisson=0.3), fixed=fem.Plane(0, 0.0))
    solver = fem.Newton(problem, 1e-9)
    return Scene(problem, fem.GravityLoads(solver.linear_solver, young=1e6), solver)


def first_channels(problem, channels):
    """A network that returns its first channels."""
    return nn.Linear(1, 1), lambda rows: rows[:, :, : problem.points.shape[1]]


@pytest.fixture(scope="module")
def parts(scene):
    return [solved(scene, scene.loads.sample(k, range(n))) for k, n in ((0, 40), (1, 5))]


def test_a_linear_body_is_learnt_exactly_by_linear_regression(scene, parts):
    sets = dict.fromkeys(("in range", "small", "twice"), parts[1])

    def fit():
        net = InCoordinates(least_squares)
        predictor = BASES["plain"](net, scene)
        net.learn_from(predictor, parts, 0.0)
        return predictor, 0.0, net.epochs, net.weights

    row = measured("least squares", "plain", 40, fit, sets)
    assert row.worst < 1e-4  # fields are rounded to float32
    alone = measured("linear solution", "linear", 0, partial(linear_solution, scene), sets)
    assert alone.worst < 1e-5


def test_inputs_and_outputs_of_a_network_of_the_nodes_are_scaled(scene):
    field, scalars = torch.randn(8, *scene.problem.shape), torch.ones(8, 1)
    net = OnNodes(first_channels, 8, scene.problem)
    net.seen = None
    net.learn([[field, scalars, 5 * field]] * 2, 0.0)
    assert torch.allclose(net(field, scalars), 5 * field)

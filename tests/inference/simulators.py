"""Simulators whose networks are functions of a load."""

import torch

from dpl.fem import SubspaceNewton, solve
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate

KNOWN = {}


def solution(scene, load):
    """Return the displacement (B, N, D) [-] that solves loads; each is solved once."""
    key = scene, load.force.numpy().tobytes(), load.parameters.numpy().tobytes()
    if key not in KNOWN:
        KNOWN[key] = solve(scene.solver, load).displacement
    return KNOWN[key].clone()


def linear_network(scene):
    """Return the prediction of the linear solution."""
    return lambda load: torch.stack([scene.linear.solve(f) for f in load.force])


def simulator_of(scene, predict=1.0, **more):
    """Return a simulator whose network is a function of a load, or a part of its solution."""
    torch.manual_seed(0)
    surrogate = Surrogate(FCNN(scene, width=4), MSE(), scene)
    is_part = isinstance(predict, float)
    surrogate.predict = (lambda load: predict * solution(scene, load)) if is_part else predict
    return Simulator(surrogate, **more)


def newton_everywhere(scene):
    """Return Newton's method in the space of all displacements."""
    problem = scene.problem
    count = int(problem.free.sum())
    vectors = torch.zeros(*problem.shape, count, dtype=torch.float64)
    vectors[problem.free] = torch.eye(count).double()
    return SubspaceNewton(problem, vectors)


def with_errors(sim, prediction, outside):
    """Let a model state these relative errors of its prediction and outside of its modes.

    They hold where the residual is below the load.
    """
    sim.surrogate.net.largest_residual = torch.tensor(1.0)
    sim.surrogate.predict_with_errors = lambda load: (
        sim.surrogate.predict(load),
        torch.tensor([[prediction, outside]] * len(load.force), dtype=torch.float64),
    )
    return sim

"""A body whose supports are moved: solvers, networks and simulator keep the prescribed motion."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from linear_solutions import BEAM, SUPPORTS

from benchmarks.plain_newton import PlainNewton
from dpl import Scene
from dpl.fem import LinearSolver, Load, ModalLoads, NeoHookeanLn, Newton, Problem, solve
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.models.linear_base import sampled_solutions
from dpl.training import MSE, Surrogate


@pytest.fixture(scope="module")
def scene():
    """A beam that is held at one end and stretched at the other."""
    body = Problem.build(BEAM, NeoHookeanLn(0.3), supports=SUPPORTS["moved"])
    newton = Newton(body, linear="superlu")
    return Scene(body, ModalLoads(newton.linear_solver, n_modes=3, deflection=0.05), newton)


@pytest.fixture(scope="module")
def small(scene):
    """A load far below the largest one."""
    load = scene.loads.sample(0, range(1))
    return load._replace(force=1e-4 * load.force)


def keeps_supports(scene, displacement):
    """Return True if displacements are those prescribed at the supports, bit for bit."""
    fixed = ~scene.problem.free
    assert scene.problem.prescribed[fixed].any()
    expected = scene.problem.prescribed[fixed].expand(len(displacement), -1)
    return torch.equal(displacement[:, fixed], expected)


def test_the_linear_solution_is_the_limit_of_small_motions(scene, small):
    body = scene.problem
    errors = []
    for factor in (0.1, 0.01):
        scaled = replace(body, prescribed=factor * body.prescribed)
        load = small._replace(force=factor * small.force)
        linear = solve(LinearSolver(scaled), load).displacement
        exact = solve(Newton(scaled), load).displacement
        errors.append(float((linear - exact).norm() / exact.norm()))
    assert errors[1] < 2e-3
    assert errors[1] < 0.12 * errors[0]  # of first order


@pytest.mark.parametrize("base", [None, "linear"])
def test_a_network_keeps_the_motion_of_the_supports(scene, small, base):
    torch.manual_seed(0)
    surrogate = Surrogate.from_network(partial(FCNN, width=4), MSE(), scene, base=base)
    with torch.no_grad():
        assert keeps_supports(scene, surrogate.predict(small))


def linear_network(scene):
    return Surrogate.from_network(partial(FCNN, width=4), MSE(), scene, base="linear")


def test_the_linear_solutions_of_scales_are_those_of_the_network(scene):
    surrogate = linear_network(scene)
    force, linear = sampled_solutions(scene)
    young = force.new_ones(len(force))
    assert keeps_supports(scene, linear)
    assert torch.allclose(
        surrogate.predictor.base.solutions(Load(force, young)), linear, rtol=0, atol=1e-6
    )


def test_linear_solutions_of_a_network_are_in_equilibrium(scene):
    body, load = scene.problem, scene.loads.sample(0, range(3))
    linear = linear_network(scene).predictor.base.solutions(load)
    assert keeps_supports(scene, linear)
    product = body.tangent_product(torch.zeros_like(linear), linear)
    residual = (product - load.force)[:, body.free].norm(dim=1)
    assert (residual < 1e-3 * product.flatten(1).norm(dim=1)).all()


@pytest.mark.parametrize("request_of", [{"tol": 1e-3}, {"error": 1e-3}], ids=["tol", "error"])
@pytest.mark.parametrize("base", [None, "linear"])
def test_an_answer_within_its_tolerance_is_the_equilibrium(scene, small, base, request_of):
    """Although the linear solution is nearly exact under a small load of a body at rest."""
    torch.manual_seed(0)
    sim = Simulator(Surrogate.from_network(partial(FCNN, width=4), MSE(), scene, base=base))
    newtons = small.force * scene.force_unit  # with a modulus of 1 Pa
    answer = sim(newtons, young=1.0, **request_of)
    met = answer.converged if "tol" in request_of else answer.error < 1e-3
    assert met.all()
    exact = scene.length * solve(scene.solver, small).displacement
    assert (answer.displacement - exact).norm() < 2e-3 * exact.norm()


def test_plain_newton_moves_the_supports(scene, small):
    answer = solve(PlainNewton(scene.newton), small)
    assert answer.converged.all()
    assert keeps_supports(scene, answer.displacement)
    assert torch.allclose(answer.displacement, solve(scene.newton, small).displacement, atol=1e-7)

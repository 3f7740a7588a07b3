"""Laws of the differentiable equilibrium: gradients equal difference quotients of solves."""

import pickle

import pytest
import torch
from solving import LENGTH, load_of, noise, rest

from dpl import fem
from dpl.fem.linear import SuperLU


@pytest.fixture(scope="module")
def problem(beam):
    return beam(fem.NeoHookeanLn(0.3), n=4, m=1)


@pytest.fixture(scope="module")
def equilibrium(problem):
    return fem.DifferentiableSolve(fem.Newton(problem, tol=1e-12, linear="superlu"))


@pytest.fixture(scope="module")
def force(problem, pull):
    """Two loads that bend the beam by a tenth and by a third of its length."""
    return torch.cat([pull(problem, 2.0), pull(problem, 10.0)])


@pytest.fixture(scope="module")
def way(problem):
    """A direction of forces without symmetry, on fixed nodes too."""
    return noise(2, *problem.shape, seed=1)


def seen(displacement):
    """Return a smooth functional of each solution, (B,)."""
    weight = noise(*displacement.shape[1:], seed=2)
    return (displacement * weight).sum(dim=(1, 2)) + displacement.square().sum(dim=(1, 2))


def slope_of(function, step):
    return (function(step) - function(-step)) / (2 * step)


def test_the_solution_is_that_of_newton(equilibrium, force):
    answer = equilibrium(load_of(force))
    assert torch.equal(answer, fem.solve(equilibrium.newton, load_of(force)).displacement)
    assert answer.dtype == torch.float64
    assert not answer.requires_grad


def test_the_gradient_by_forces_is_the_difference_quotient(problem, equilibrium, force, way):
    inner = force.clone().requires_grad_()
    (slope,) = torch.autograd.grad(seen(equilibrium(load_of(inner))).sum(), inner)
    size = float(force[0].norm() / way[0].norm())

    def along(step):
        return seen(equilibrium(load_of(force + step * size * way)))

    found = (slope * way).sum(dim=(1, 2)) * size
    expected = slope_of(along, 1e-4)
    assert expected.abs().min() > 1e-3
    assert torch.allclose(found, expected, rtol=1e-5, atol=0)
    assert (slope[:, ~problem.free] == 0).all()
    assert (slope[:, problem.free] != 0).any()


def test_the_gradient_by_young_and_force_is_the_difference_quotient(scene, batch):
    """Through `Scene.load_of`: u/L depends on f/(E L^2) alone, so f df + E dE = 0 as well."""
    equilibrium = fem.DifferentiableSolve(fem.Newton(scene.problem, tol=1e-12, linear="superlu"))
    young = torch.tensor([4500.0, 9000.0], dtype=torch.float64)
    newtons = batch.force[:2] * (young * scene.force_unit)[:, None, None]

    def metres(newtons, young):
        return scene.length * equilibrium(scene.load_of(newtons, young))

    inner = newtons.clone().requires_grad_(), young.clone().requires_grad_()
    by_force, by_young = torch.autograd.grad(seen(metres(*inner)).sum(), inner)
    expected = slope_of(lambda step: seen(metres(newtons, young * (1 + step))), 1e-4) / young
    assert torch.allclose(by_young, expected, rtol=1e-5, atol=0)
    expected = slope_of(lambda step: seen(metres(newtons * (1 + step), young)), 1e-4)
    assert torch.allclose((by_force * newtons).sum(dim=(1, 2)), expected, rtol=1e-5, atol=0)
    assert torch.allclose((by_force * newtons).sum(dim=(1, 2)), -by_young * young, rtol=1e-8)


def test_repeated_gradients_take_one_factorisation(equilibrium, force, monkeypatch):
    answer = equilibrium(load_of(force.clone().requires_grad_()))
    made = []
    factorise = SuperLU.factorise
    monkeypatch.setattr(SuperLU, "factorise", lambda *given: made.append(1) or factorise(*given))
    for component in answer[:, -1].sum(dim=0):
        component.backward(retain_graph=True)
    assert len(made) == 2  # of two loads


def test_moved_supports_and_springs_are_included(pull):
    ends = [
        fem.DirichletBC(fem.Plane(0, "max"), [5.0, None, None]),
        fem.RobinBC(fem.Plane(2, "min"), 1e-4),
    ]
    mesh = fem.box([LENGTH, 25.0, 25.0], [5, 2, 2])
    problem = fem.Problem.build(
        mesh, fem.NeoHookeanLn(0.3), fixed=fem.Plane(0, "min"), supports=ends
    )
    equilibrium = fem.DifferentiableSolve(fem.Newton(problem, tol=1e-12, linear="superlu"))
    force, way = pull(problem, 5.0), noise(1, *problem.shape, seed=3)
    inner = force.clone().requires_grad_()
    answer = equilibrium(load_of(inner))
    assert torch.equal(answer[0][~problem.free], problem.prescribed[~problem.free])
    (slope,) = torch.autograd.grad(seen(answer).sum(), inner)
    size = 0.1 * float(force.norm() / way.norm())
    expected = slope_of(lambda step: seen(equilibrium(load_of(force + step * size * way))), 1e-3)
    assert float((slope * way).sum()) * size == pytest.approx(float(expected), rel=1e-5)


def test_an_unstable_column_has_a_gradient(beam):
    """The tangent is indefinite and not singular."""
    problem = beam(fem.NeoHookeanLn(0.3), n=8, m=1)
    equilibrium = fem.DifferentiableSolve(fem.Newton(problem, tol=1e-12, linear="superlu"))
    tip = (problem.points[:, 0] == problem.points[:, 0].max()).double()
    axial = rest(problem)
    axial[0, :, 0] = -tip / tip.sum()

    def shortened(load):
        return -equilibrium(load_of(load * axial))[0, :, 0].min()

    load = torch.tensor(0.006, dtype=torch.float64, requires_grad=True)
    answer = fem.solve(equilibrium.newton, load_of(load.detach() * axial))
    assert answer.status.tolist() == [fem.Status.UNSTABLE]
    assert int(answer.negative_pivots) > 0
    (slope,) = torch.autograd.grad(shortened(load), load)
    with torch.no_grad():
        expected = slope_of(lambda step: shortened(load + step), 1e-5)
    assert float(slope) == pytest.approx(float(expected), rel=1e-5)


def test_a_guess_saves_iterations_and_changes_neither_solution_nor_gradient(equilibrium, force):
    cold = load_of(force.clone().requires_grad_())
    warm = load_of(force.clone().requires_grad_())
    first = equilibrium(cold)
    again = equilibrium(warm, guess=first)
    assert torch.allclose(first, again, rtol=0, atol=1e-10)
    *_, last = equilibrium.newton.iterate(load_of(force), guess=first.detach())
    assert (last.iterations <= 1).all()
    slopes = [
        torch.autograd.grad(seen(u).sum(), load.force)[0]
        for u, load in ((first, cold), (again, warm))
    ]
    assert torch.allclose(*slopes, rtol=1e-7, atol=1e-9)


def test_error_names_the_loads_without_a_solution(problem, force):
    equilibrium = fem.DifferentiableSolve(fem.Newton(problem, linear="superlu", max_total_iter=2))
    too_large = torch.cat([0 * force[:1], 100 * force[1:]]).requires_grad_()
    with pytest.raises(ValueError, match="of 2 loads, load 1: not converged"):
        equilibrium(load_of(too_large))


def test_a_critical_load_has_no_gradient(equilibrium, force, monkeypatch):
    def critical(backend, values):
        raise fem.SingularMatrix("a pivot is zero")

    answer = equilibrium(load_of(force.clone().requires_grad_()))
    monkeypatch.setattr(SuperLU, "factorise", critical)
    with pytest.raises(fem.SingularMatrix):
        answer.sum().backward()


def test_float32_forces_get_float32_gradients(equilibrium, force):
    single = force.float().requires_grad_()
    answer = equilibrium(load_of(single))
    assert answer.dtype == torch.float64
    answer.sum().backward()
    assert single.grad.dtype == torch.float32


def test_a_differentiable_solve_can_be_pickled(equilibrium, force):
    equilibrium(load_of(force.clone().requires_grad_())).sum().backward()
    twin = pickle.loads(pickle.dumps(equilibrium))
    assert torch.equal(twin(load_of(force)), equilibrium(load_of(force)))

"""Laws of Anderson acceleration: Newton's solution from good guesses, an early stop otherwise."""

from dataclasses import replace

import pytest
import torch

from dpl import fem


def case(dim=3, law=None, degree=1, **more):
    """Return a slender body, its Newton and a load across its far end."""
    mesh = fem.box([4.0, 1.0, 1.0], [9, 3, 3]) if dim == 3 else fem.rectangle([4.0, 1.0], [13, 4])
    law = law or fem.NeoHookeanLn(0.3)
    problem = fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"), degree=degree, **more)
    direction = [0.0] * (dim - 1) + [-2e-3 if dim == 3 else -8e-3]
    force = fem.Traction(fem.Plane(0, "max"), direction).on(problem)
    return fem.Newton(problem), fem.Load(force[None], torch.ones(1, dtype=torch.float64))


def end(solver, load, guess):
    *_, last = solver.iterate(load, guess=guess)
    return last


@pytest.fixture(scope="module")
def usual():
    """Newton of a beam, a load and its solution."""
    newton, load = case()
    return newton, load, fem.solve(newton, load).displacement


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"law": fem.SaintVenantKirchhoff(0.3)},
        {"dim": 2},
        {"degree": 2},
        {"mean_dilatation": True},
        {"supports": [fem.DirichletBC(fem.Plane(1, "min"), [None, 0.0, None])]},
    ],
    ids=str,
)
def test_a_good_guess_leads_to_the_solution_of_newton(options):
    newton, load = case(**options)
    exact = fem.solve(newton, load).displacement
    assert exact.norm(dim=-1).max() > 0.05, "or it would prove nothing"
    answer = end(fem.AndersonSolver(newton), load, 1.003 * exact)
    assert answer.converged.all()
    assert (answer.residual < newton.tol).all()
    assert torch.allclose(answer.displacement, exact, rtol=0, atol=1e-8)
    assert not answer.factorisations.any()
    assert 1 <= int(answer.iterations) <= 20


def test_a_linear_problem_takes_one_or_two_iterations(usual):
    """The factor of K(0) is accurate to about 1e-5."""
    newton, load, _ = usual
    tiny = load._replace(force=1e-7 * load.force)
    answer = end(fem.AndersonSolver(replace(newton, tol=1e-4)), tiny, torch.zeros_like(load.force))
    assert answer.converged.all()
    assert int(answer.iterations) <= 2


def test_a_poor_guess_ends_early_without_convergence(usual):
    newton, load, exact = usual
    inverted = -1.5 * newton.problem.points[None] * newton.problem.free
    for guess in (torch.full_like(exact, torch.nan), inverted):
        (state,) = fem.AndersonSolver(newton).iterate(load, guess=guess)
        assert not state.converged.any()
    assert len(list(fem.AndersonSolver(newton).iterate(load, guess=-exact))) <= 31


def test_supports_are_moved_for_any_guess():
    newton, load = case(supports=[fem.DirichletBC(fem.Plane(0, "max"), [0.0, 0.0, -0.3])])
    exact = fem.solve(newton, load).displacement
    guess = exact + 1e-4 * torch.randn(exact.shape, generator=torch.Generator().manual_seed(0))
    answer = end(fem.AndersonSolver(newton), load, guess.double())
    held = ~newton.problem.free
    assert torch.equal(answer.displacement[:, held], newton.problem.prescribed[None][:, held])
    assert answer.converged.all()


def test_a_batch_is_solved_like_its_members(usual):
    newton, load, exact = usual
    both = fem.Load(torch.cat([load.force, 0.5 * load.force]), torch.ones(2, dtype=torch.float64))
    guess = torch.cat([1.002 * exact, 0.5 * exact])
    whole = end(fem.AndersonSolver(newton), both, guess)
    for k, single in enumerate(both.unbatch()):
        alone = end(fem.AndersonSolver(newton), single, guess[k : k + 1])
        assert torch.equal(whole.displacement[k], alone.displacement[0])
        assert int(whole.iterations[k]) == int(alone.iterations)


def test_convergence_is_slower_without_memory(usual):
    newton, load, exact = usual
    long, short = (
        end(fem.AndersonSolver(newton, memory=memory), load, 1.003 * exact) for memory in (12, 1)
    )
    assert long.converged.all()
    assert int(long.iterations) <= int(short.iterations)


def test_every_state_has_its_own_internal_force_and_that_of_the_guess_may_be_given(usual):
    newton, load, exact = usual
    guess, solver = 1.003 * exact, fem.AndersonSolver(newton)
    known = newton.problem.evaluate(guess)
    states = solver.iterate(load, guess=guess), solver.iterate(load, guess=guess, evaluation=known)
    for one, other in zip(*states, strict=True):
        assert torch.equal(one.internal, newton.problem.evaluate(one.displacement).internal)
        assert torch.equal(one.displacement, other.displacement)

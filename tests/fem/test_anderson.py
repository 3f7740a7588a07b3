"""Laws of Anderson acceleration: Newton's solution from good guesses, an early stop otherwise."""

from dataclasses import replace

import pytest
import torch

from dpl.fem import (
    AndersonSolver,
    DirichletBC,
    Load,
    NeoHookeanLn,
    Newton,
    Plane,
    Problem,
    SaintVenantKirchhoff,
    Traction,
    box,
    rectangle,
    solve,
)


def case(dim=3, law=None, degree=1, **more):
    """Return a slender body, its Newton and a load across its far end."""
    mesh = box([4.0, 1.0, 1.0], [9, 3, 3]) if dim == 3 else rectangle([4.0, 1.0], [13, 4])
    law = law or NeoHookeanLn(0.3)
    problem = Problem.build(mesh, law, fixed=Plane(0, "min"), degree=degree, **more)
    direction = [0.0] * (dim - 1) + [-2e-3 if dim == 3 else -8e-3]
    force = Traction(Plane(0, "max"), direction).on(problem)
    return Newton(problem), Load(force[None], torch.ones(1, dtype=torch.float64))


def end(solver, load, guess):
    *_, last = solver.iterate(load, guess=guess)
    return last


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"law": SaintVenantKirchhoff(0.3)},
        {"dim": 2},
        {"degree": 2},
        {"mean_dilatation": True},
        {"supports": [DirichletBC(Plane(1, "min"), [None, 0.0, None])]},
    ],
    ids=str,
)
def test_a_good_guess_leads_to_the_solution_of_newton(options):
    newton, load = case(**options)
    exact = solve(newton, load).displacement
    assert exact.norm(dim=-1).max() > 0.05, "or it would prove nothing"
    answer = end(AndersonSolver(newton), load, 1.003 * exact)
    assert answer.converged.all()
    assert (answer.residual < newton.tol).all()
    assert torch.allclose(answer.displacement, exact, rtol=0, atol=1e-8)
    assert not answer.factorisations.any()
    assert 1 <= int(answer.iterations) <= 20


def test_a_linear_problem_takes_one_iteration():
    newton, load = case()
    tiny = load._replace(force=1e-7 * load.force)
    answer = end(AndersonSolver(replace(newton, tol=1e-4)), tiny, torch.zeros_like(load.force))
    assert answer.converged.all()
    assert int(answer.iterations) == 1


@pytest.mark.parametrize("kind", ["nan", "inverted", "far"])
def test_a_poor_guess_ends_early_without_convergence(kind):
    newton, load = case()
    exact = solve(newton, load).displacement
    guess = {
        "nan": torch.full_like(exact, torch.nan),
        "inverted": -1.5 * newton.problem.points[None] * newton.problem.free,
        "far": -exact,
    }[kind]
    states = list(AndersonSolver(newton).iterate(load, guess=guess))
    assert not states[-1].converged.any() or kind == "far"
    assert len(states) <= 31
    assert len(states) == 1 or kind == "far"


def test_supports_are_moved_for_any_guess():
    newton, load = case(supports=[DirichletBC(Plane(0, "max"), [0.0, 0.0, -0.3])])
    exact = solve(newton, load).displacement
    guess = exact + 1e-4 * torch.randn(exact.shape, generator=torch.Generator().manual_seed(0))
    answer = end(AndersonSolver(newton), load, guess.double())
    held = ~newton.problem.free
    assert torch.equal(answer.displacement[:, held], newton.problem.prescribed[None][:, held])
    assert answer.converged.all()


def test_a_batch_is_solved_like_its_members():
    newton, load = case()
    both = Load(torch.cat([load.force, 0.5 * load.force]), torch.ones(2, dtype=torch.float64))
    guess = 1.002 * solve(newton, both).displacement
    whole = end(AndersonSolver(newton), both, guess)
    for k, single in enumerate(both.unbatch()):
        alone = end(AndersonSolver(newton), single, guess[k : k + 1])
        assert torch.equal(whole.displacement[k], alone.displacement[0])
        assert int(whole.iterations[k]) == int(alone.iterations)


def test_convergence_is_slower_without_memory():
    newton, load = case()
    guess = 1.003 * solve(newton, load).displacement
    long, short = (end(AndersonSolver(newton, memory=memory), load, guess) for memory in (12, 1))
    assert long.converged.all()
    assert int(long.iterations) <= int(short.iterations)

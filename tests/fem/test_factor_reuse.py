"""Laws of factor reuse: the same solutions with fewer factorisations."""

from dataclasses import replace
from functools import partial
from itertools import cycle

import numpy as np
import pytest
import torch
from laws import LAWS
from solving import inertia, load_of
from torch import Tensor

from benchmarks.stress.fixtures import column, cube
from dpl import fem
from dpl.fem.linear import Pardiso, SuperLU, multigrid_installed
from dpl.fem.linear.superlu import SuperLUFactor
from dpl.fem.solvers import factor_reuse as reuse_module

NH, SVK = fem.NeoHookeanLn(0.3), fem.SaintVenantKirchhoff(0.3)


def pair(problem: fem.Problem, load: fem.Load, guess: Tensor | None = None, **options):
    """Return the solutions without and with factor reuse."""
    answers = []
    for reuse in (0.0, fem.Newton(problem).factor_reuse_tol):
        solver = fem.Newton(problem, **{"linear": "superlu", "factor_reuse_tol": reuse, **options})
        *_, last = solver.iterate(load, guess=guess)
        answers.append(last)
    return answers


def check(every: fem.Solution, few: fem.Solution, *, steps: int = 1, fewer: bool = True) -> None:
    """Assert that two solutions are equal and that the second took less work.

    Args:
        every: Solution without factor reuse.
        few: Solution with factor reuse.
        steps: Load steps, each of which may take one more iteration.
        fewer: Whether there must be fewer factorisations.
    """
    assert few.status.tolist() == every.status.tolist()
    assert (few.load_factor - every.load_factor).abs().max() < 1e-3
    whole = every.load_factor == 1
    assert torch.allclose(few.displacement[whole], every.displacement[whole], rtol=0, atol=1e-9)
    assert (few.residual[whole] < 1e-8).all()
    assert (few.iterations <= every.iterations + steps).all()
    assert (few.factorisations <= every.factorisations).all()
    if fewer:
        assert (few.factorisations < every.factorisations).all()


@pytest.mark.parametrize(
    ("name", "q", "mixed"),
    [("neo_hookean_ln", q, mixed) for q in (1.0, 20.0, 80.0) for mixed in (False, True)]
    + list(zip([*LAWS][::3], cycle([80.0, 20.0, 1.0]), cycle([True, False]))),
)
def test_solution_of_any_law_does_not_depend_on_reuse(beam, pull, name, q, mixed):
    problem = beam(LAWS[name])
    every, few = pair(problem, load_of(pull(problem, q)), mixed_integration=mixed)
    assert every.converged.all()
    check(every, few, fewer=every.iterations.item() > 2)


def test_solution_on_any_element_does_not_depend_on_reuse(grid, kind):
    cell, degree = kind
    mesh = grid(cell, 4 - degree, 0.2, inside=True)
    problem = fem.Problem.build(mesh, NH, fixed=fem.Plane(0, "min"), degree=degree)
    across = [0.0] * (mesh.dim() - 1) + [0.1]
    every, few = pair(problem, load_of(fem.Traction(fem.Plane(0, "max"), across).on(problem)[None]))
    assert every.converged.all()
    check(every, few)


@pytest.mark.parametrize("name", fem.installed_backends())
def test_solution_of_any_backend_does_not_depend_on_reuse(beam, pull, name):
    problem = beam(NH, 12, 3)
    every, few = pair(problem, load_of(pull(problem, 80.0)), linear=name)
    assert every.converged.all()
    check(every, few, fewer=name != "cg" or multigrid_installed())  # the diagonal spares none


@pytest.mark.parametrize(("q", "mixed"), [(160.0, True), (400.0, False)])
def test_large_load_that_takes_steps_does_not_depend_on_reuse(beam, pull, mixed, q):
    problem = beam(NH)
    load = load_of(pull(problem, q))
    plain = fem.Newton(problem, linear="superlu", mixed_integration=mixed, factor_reuse_tol=0.0)
    states = list(plain.iterate(load))
    steps, every = 1 + len({state.load_factor.item() for state in states}), states[-1]
    few = fem.solve(replace(plain, factor_reuse_tol=fem.Newton(problem).factor_reuse_tol), load)
    assert every.converged.all()
    check(every, few, steps=steps, fewer=mixed)


def test_load_without_a_solution_has_none_with_reuse(beam, pull, mixed):
    problem = beam(SVK)
    options = {"min_load_step": 2.0**-4, "mixed_integration": mixed}
    every, few = pair(problem, load_of(pull(problem, 400.0)), **options)
    assert every.status.item() == few.status.item() == fem.Status.NO_VALID_EQUILIBRIUM
    assert 0 < few.load_factor.item() < 1
    assert few.load_factor.item() == pytest.approx(every.load_factor.item(), abs=1e-9)
    assert torch.allclose(few.displacement, every.displacement, rtol=0, atol=1e-2)


@pytest.mark.parametrize(("law", "mixed"), [(NH, True), (SVK, False)])
def test_moved_supports_are_followed_with_reuse(law, mixed):
    mesh = fem.box([1.0, 1.0, 1.0], [4, 4, 4])
    held = mesh.p.T == 0
    held[:, 0] |= mesh.p[0] == 1
    given = np.where(mesh.p[0] == 1, 0.5, 0.0)[:, None] * np.array([1, 0, 0])
    problem = fem.Problem.build(mesh, law, fixed=held, prescribed=given, length=1.0)
    sideways = fem.Traction(fem.Plane(2, "max"), [0.0, 0.0, 0.01]).on(problem)
    for force in (torch.zeros_like(sideways), sideways):
        every, few = pair(problem, load_of(force[None]), mixed_integration=mixed)
        assert every.converged.all()
        check(every, few)


@pytest.mark.parametrize(("law", "part"), [(NH, 0.5), (SVK, 1.0001), (NH, -0.2)])
def test_guess_leads_to_the_same_solution_with_reuse(beam, pull, law, part):
    problem = beam(law)
    load = load_of(pull(problem, 20.0))
    answer = fem.solve(
        fem.Newton(problem, tol=1e-12, linear="superlu", factor_reuse_tol=0.0), load
    ).displacement
    every, few = pair(problem, load, guess=part * answer)
    assert every.converged.all()
    check(every, few, fewer=every.iterations.item() > 2)
    assert few.factorisations.item() >= 1  # the factor of the rest state is near no other


def test_more_reuse_means_fewer_factors(beam, pull):
    problem = beam(NH, 12, 3)
    newton, load = fem.Newton(problem, linear="superlu"), load_of(pull(problem, 20.0))
    for reuse, count in {0.0: 4, 1e-3: 3, 0.1: 2, 1e6: 1}.items():
        answer = fem.solve(replace(newton, factor_reuse_tol=reuse), load)
        assert answer.converged.all()
        assert answer.iterations.item() == 5
        assert answer.factorisations.item() == count


def test_factorisations_of_a_batch_are_all_counted(beam, pull, counted):
    problem = beam(NH)
    load = load_of(torch.cat([pull(problem, q) for q in (5.0, 40.0, 160.0)]))
    solver = fem.Newton(problem, linear="superlu")
    solver.linear_solver.factor  # noqa: B018  the scene's
    counted.clear()
    answer = fem.solve(solver, load)
    assert int(answer.factorisations.sum()) == len(counted)
    assert (answer.factorisations > 0).all()
    assert (answer.factorisations < answer.iterations - 1).all()


def test_poor_preconditioner_is_replaced_after_the_largest_number_of_steps(
    beam, pull, monkeypatch, counted
):
    """It costs a few products; iterations and solution are the same."""
    problem = beam(NH)
    load = load_of(pull(problem, 40.0))
    every, few = pair(problem, load)
    steps = []
    original = reuse_module.conjugate_gradients

    def poor_preconditioner(product, precondition, right, rtol, max_iter, **_):
        steps.append(max_iter)
        return original(product, lambda r: r, right, rtol, max_iter)

    monkeypatch.setattr(reuse_module, "conjugate_gradients", poor_preconditioner)
    answer = fem.solve(fem.Newton(problem, linear="superlu"), load)
    assert answer.converged.all()
    assert answer.iterations.item() == every.iterations.item()
    assert answer.factorisations.item() == every.factorisations.item() > few.factorisations.item()
    assert set(steps) == {reuse_module.MAX_CG_STALE}
    assert torch.equal(answer.displacement, every.displacement)


@pytest.mark.skipif("pardiso" not in fem.installed_backends(), reason="pardiso is not installed")
def test_pardiso_factorises_no_tangent_of_a_batch_again(beam, pull, monkeypatch):
    """It stores one factor at a time."""
    calls, original = [], Pardiso.store_factor
    problem = beam(NH)
    load = load_of(torch.cat([pull(problem, q) for q in (5.0, 10.0, 20.0, 40.0)]))
    solver = fem.Newton(problem, linear="pardiso")
    solver.linear_solver.factor  # noqa: B018
    monkeypatch.setattr(Pardiso, "store_factor", lambda *pair: calls.append(1) or original(*pair))
    assert int(fem.solve(solver, load).factorisations.sum()) == len(calls)


# ---- stability


BODIES = {  # body with its unit load, critical load (independent code)
    "SVK column": (partial(column, fem.SaintVenantKirchhoff(0.0), (10, 1, 1)), 2.039763),
    "NH column": (partial(column, fem.NeoHookeanLn(0.0), (10, 1, 1)), 2.056558),
    "cube, nu = .45": (partial(cube, fem.NeoHookeanLn(0.45), 1, (0, 1, 2)), 0.7475041023),
    "cube, nu = .49": (partial(cube, fem.NeoHookeanLn(0.49), 1, (0, 1, 2)), 0.6804639956),
}


@pytest.mark.filterwarnings("ignore:linear .* lock")
@pytest.mark.parametrize(
    ("name", "part", "linear", "reuse"),
    [
        *(("SVK column", 1.0005, "superlu", reuse) for reuse in (0.0, 0.1, 1.0)),
        ("NH column", 1.0005, "superlu", 1.0),
        ("NH column", 1.05, "superlu", 0.1),
        ("cube, nu = .45", 1.0005, "superlu", 0.1),
        ("cube, nu = .49", 1.002, "superlu", 0.0),
        ("SVK column", 1.001, "band", 0.1),
        ("SVK column", 1.001, "band32", 1.0),
        ("SVK column", 1.001, "pardiso", 0.1),
    ],
)
def test_load_beyond_a_critical_one_is_unstable_whatever_is_reused(name, part, linear, reuse):
    """The column, and the cube of Rivlin (1948)."""
    if linear not in fem.installed_backends():
        pytest.skip(f"{linear} is not installed")
    (build, critical), options = (
        BODIES[name],
        {"tol": 1e-10, "linear": linear, "factor_reuse_tol": reuse},
    )
    problem, unit = build()
    answer = fem.solve(fem.Newton(problem, **options), load_of(part * critical * unit[None]))
    assert answer.converged.all()
    assert inertia(problem, answer.displacement) == 2
    assert answer.status.item() == fem.Status.UNSTABLE
    assert answer.negative_pivots.item() == 2


@pytest.mark.filterwarnings("ignore:linear .* lock")
@pytest.mark.parametrize("name", BODIES)
def test_load_below_a_critical_one_is_stable_whatever_is_reused(name):
    build, critical = BODIES[name]
    problem, unit = build()
    every, few = pair(problem, load_of(0.999 * critical * unit[None]), tol=1e-10)
    assert inertia(problem, few.displacement) == 0
    assert few.status.item() == fem.Status.CONVERGED
    check(every, few, fewer=False)


@pytest.mark.parametrize(("P", "linear"), [(2.1, "superlu"), (2.5, "band"), (4.0, "superlu")])
def test_factor_with_negative_pivots_is_never_reused(monkeypatch, P, linear):
    """Conjugate gradients need a positive definite preconditioner."""
    problem, unit = BODIES["SVK column"][0]()
    used, met, original = [], [], SuperLU.factorise

    def watched(self, values):
        factor = original(self, values)
        met.append(factor.negative_pivots)
        return factor

    monkeypatch.setattr(SuperLU, "factorise", watched)
    monkeypatch.setattr("dpl.fem.linear.backends.installed_backends", lambda: ["band", "superlu"])
    monkeypatch.setattr(
        SuperLUFactor, "apply", lambda self, r: used.append(self.negative_pivots) or self.solve(r)
    )
    solver = fem.Newton(problem, tol=1e-10, linear=linear, factor_reuse_tol=1e6)
    answer = fem.solve(solver, load_of(P * unit[None]))
    assert answer.status.item() == fem.Status.UNSTABLE
    assert [count for count in met if count > 0][:2] == [2, 2]
    assert not any(used)

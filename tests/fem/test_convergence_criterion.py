"""Laws of the one criterion: what every solver takes as in balance, and which tolerances it takes.

||R_free|| / ||f|| counts forces on free degrees of freedom only, and it is formed without squares
that underflow.
"""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from dpl import fem
from dpl.data.solving.solve import LoadKey, failed_load, solve_load
from dpl.fem.linear import conjugate_gradients
from dpl.inference import Direct, Hybrid
from dpl.inference.hybrid import RULES

ONE = torch.ones(1, dtype=torch.float64)


@pytest.fixture(scope="module")
def newton() -> fem.Newton:
    """A beam 4 x 1 x 1 of 24 hexahedra."""
    problem = fem.Problem.build(
        fem.box([4.0, 1, 1], [7, 3, 3]), fem.NeoHookeanLn(0.3), fixed=fem.Plane(0, "min")
    )
    return fem.Newton(problem, linear="superlu")


@pytest.fixture(scope="module")
def load(newton) -> fem.Load:
    """A traction across its end, which moves that by a tenth of the length."""
    force = fem.Traction(fem.Plane(0, "max"), [1e-4, 0.0, -1e-3]).on(newton.problem)
    return fem.Load(force[None], ONE)


@pytest.fixture(scope="module")
def solvers(newton, load):
    """Every solver: from a load to its last solution."""
    exact = fem.solve(newton, load).displacement
    assert 0.05 < exact.norm(dim=-1).max() < 0.5
    problem, guess = newton.problem, 1.001 * exact
    hybrids = {rule: Hybrid(lambda load: guess, newton, rule) for rule in RULES}
    hybrids["steps"] = Hybrid(lambda load: guess, newton, steps=fem.AndersonSolver(newton))
    return {
        "newton": partial(fem.solve, newton),
        "newton from a guess": lambda load: [*newton.iterate(load, guess=guess)][-1],
        "accelerated": lambda load: [*fem.AndersonSolver(newton).iterate(load, guess=guess)][-1],
        "linear": partial(fem.solve, newton.linear_solver),
        "direct": partial(fem.solve, Direct(lambda load: guess, problem)),
        **{f"hybrid, {name}": partial(fem.solve, hybrid) for name, hybrid in hybrids.items()},
    }


SOLVERS = [
    *("newton", "newton from a guess", "accelerated", "linear", "direct"),
    *("hybrid, natural_monotonicity", "hybrid, paper", "hybrid, steps"),
]


def same(one: fem.Solution, other: fem.Solution) -> bool:
    """Return whether two solutions are one, but for the time that they took."""
    pairs = zip(one._replace(seconds=other.seconds), other, strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("name", SOLVERS)
def test_forces_on_held_nodes_change_no_answer(newton, load, solvers, name):
    plain = solvers[name](load)
    for size in (1.0, 1e10):
        held = load._replace(force=torch.where(newton.problem.free, load.force, size))
        assert same(solvers[name](held), plain)


@pytest.mark.parametrize("name", sorted({*SOLVERS} - {"direct", "accelerated"}))
def test_forces_on_held_nodes_alone_leave_the_body_at_rest(newton, load, solvers, name):
    """A guess of something else is none of this load's, as it is none of no load's."""
    only = load._replace(force=1e10 * (~newton.problem.free).double()[None])
    answer = solvers[name](only)
    assert answer.converged.all()
    assert not answer.displacement.any()
    assert float(answer.residual) == 0


@pytest.mark.parametrize("power", [-280, -158, -100])
@pytest.mark.parametrize("name", ["newton", "linear"])
def test_tiny_loads_are_answered_as_small_ones_are(newton, load, solvers, name, power):
    size = 10.0**power
    tiny = load._replace(force=size * load.force)
    linear = newton.linear_solver.solve(load.force[0])
    answer = solvers[name](tiny)
    assert answer.converged.all()
    assert 0 < float(answer.residual) < 1e-8
    assert_close(answer.displacement[0] / size, linear, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("power", [158, 200, 290])
@pytest.mark.parametrize("name", SOLVERS)
def test_huge_loads_are_never_answered(load, solvers, name, power):
    answer = solvers[name](load._replace(force=10.0**power * load.force))
    assert not answer.converged.any()
    assert not (answer.residual < 0.5).any()


def test_loads_that_arithmetic_cannot_resolve_are_never_answered(load, solvers):
    tiny = load._replace(force=1e-300 * (load.force / load.force.abs().max()))
    for name in ("newton", "linear", "direct"):
        assert not solvers[name](tiny).converged.any()


TAKERS = {
    "newton": lambda newton, tol: fem.Newton(newton.problem, tol=tol),
    "changed newton": lambda newton, tol: replace(newton, tol=tol),
    "linear": lambda newton, tol: fem.LinearSolver(newton.problem, tol=tol),
    "direct": lambda newton, tol: Direct(lambda load: load.force, newton.problem, tol),
    "judge": lambda newton, tol: fem.evaluate_solution(
        newton.problem,
        torch.zeros(1, *newton.problem.shape, dtype=torch.float64),
        fem.Load(torch.zeros(1, *newton.problem.shape, dtype=torch.float64), ONE),
        tol,
    ),
}


@pytest.mark.parametrize("tol", [1, 1.0, 100.0, math.inf, 9e-16, 1e-20, 0.0, -1e-8, math.nan])
@pytest.mark.parametrize("name", TAKERS)
def test_a_tolerance_out_of_range_is_refused_wherever_one_is_taken(newton, name, tol):
    with pytest.raises(ValueError, match=f"^tol = {tol} must be at least 1e-15 and below 1$"):
        TAKERS[name](newton, tol)


@pytest.mark.parametrize("tol", [1e-15, 0.999])
@pytest.mark.parametrize("name", TAKERS)
def test_a_tolerance_in_range_is_taken(newton, name, tol):
    assert TAKERS[name](newton, tol) is not None


def test_only_newton_takes_for_balance_what_rounding_leaves(newton, load):
    """It has tried; of a prediction whose residual is small no one knows that it is the least."""
    exact = fem.solve(replace(newton, tol=1e-11), load).displacement
    problem, tol = newton.problem, 1e-15
    for ratio in (
        fem.evaluate_solution(problem, exact, load, tol),
        fem.solve(fem.LinearSolver(problem, tol), load),
    ):
        assert not ratio.converged.any()
    with pytest.warns(UserWarning, match="rounding allows no less"):
        ended = [*replace(newton, tol=tol).iterate(load, guess=exact)][-1]
    assert ended.converged.all()
    assert int(ended.iterations) >= 1


def test_a_right_hand_side_of_any_size_is_solved_by_conjugate_gradients():
    diagonal = np.linspace(1.0, 9.0, 20)
    right = np.sin(np.arange(20.0))
    for power in (-290, -200, -158, 0, 158, 200, 290):
        size = 10.0**power
        x = conjugate_gradients(lambda v: diagonal * v, lambda v: v, size * right, 1e-12, 30)
        np.testing.assert_allclose(x / size, right / diagonal, rtol=1e-9)
    assert not conjugate_gradients(lambda v: v, lambda v: v, np.zeros(3), 1e-12, 3).any()


def test_where_a_load_lies_does_not_depend_on_forces_on_held_nodes(newton):
    weight = torch.full(newton.problem.shape, -1e-5, dtype=torch.float64)
    for always in (None, weight):
        loads = fem.ModalLoads(newton.linear_solver, n_modes=3, constant_force=always)
        force = loads.sample(0, range(3)).force
        held = torch.where(newton.problem.free, force, 1e10)
        found, wanted = loads.project(held), loads.project(force)
        for one, other in zip(found, wanted, strict=True):
            assert torch.equal(one, other)
        assert (wanted[1] < 1e-9).all()


@pytest.mark.parametrize("power", [-290, -158, 0, 158])
def test_where_a_load_lies_scales_with_it(newton, power):
    loads = fem.ModalLoads(newton.linear_solver, n_modes=3)
    force, size = loads.sample(0, range(3)).force, 10.0**power
    amplitude, out_of_span = loads.project(size * force)
    assert_close(amplitude / size, loads.project(force)[0], rtol=1e-9, atol=0)
    assert (out_of_span < 1e-9).all()


def test_the_size_of_a_load_in_a_data_set_is_that_on_free_nodes(make_scene):
    weight = torch.full((45, 3), -1e-5, dtype=torch.float64)
    scene = make_scene(constant_force=weight)
    job = LoadKey((0, 0), 1)
    force = scene.loads.sample(job.seed, [job.number]).force
    wanted = float(force[:, scene.problem.free].norm()) / scene.loads.largest_force
    assert solve_load(scene, job).amplitude == pytest.approx(wanted, rel=1e-12)
    assert failed_load(scene, job, "lost").amplitude == pytest.approx(wanted, rel=1e-12)


def test_forces_on_held_nodes_do_not_bend_a_column(make_scene):
    """The small force that lets a column give way is a part of the load that acts on it."""
    scene = make_scene(size=(10.0, 1.0, 1.0), nodes=(11, 3, 3))
    problem, newton = scene.problem, scene.solver
    force = torch.zeros(1, *problem.shape, dtype=torch.float64)
    end = problem.points[:, 0] == 1.0
    force[:, end, 0] = -2 * math.pi**2 / 4 * (0.1**4 / 12) / int(end.sum())
    plain = fem.Load(force, ONE)
    held = fem.Load(torch.where(problem.free, force, 1e3), ONE)
    straight = fem.solve(newton, plain)
    assert straight.status[0] == fem.Status.UNSTABLE
    for one, other in zip(
        fem.post_buckling_branches(newton, held, straight),
        fem.post_buckling_branches(newton, plain, straight),
        strict=True,
    ):
        assert torch.equal(one.displacement, other.displacement)


def test_linear_elasticity_is_answered_in_one_step_as_long_as_no_cell_nearly_collapses(newton):
    """Its tangent is one for all loads; what ends the steps is min det F, which is not linear."""
    problem = fem.Problem.build(
        fem.box([4.0, 1, 1], [7, 3, 3]), fem.LinearElastic(0.3), fixed=fem.Plane(0, "min")
    )
    solver = fem.Newton(problem, linear="superlu")
    unit = fem.Traction(fem.Plane(0, "max"), [-1.0, 0.0, 0.0]).on(problem)[None]
    straight = solver.linear_solver.solve(unit[0])[None]

    def pressed(volume: float) -> tuple[float, fem.Solution]:
        low, high = 0.0, 2.0  # at which some point has det F of this volume ratio
        for _ in range(60):
            middle = (low + high) / 2
            above = float(problem.volume_ratio(middle * straight)) > volume
            low, high = (middle, high) if above else (low, middle)
        return low, fem.solve(solver, fem.Load(low * unit, ONE))

    for volume in (0.9, 0.21):  # above `keep`
        size, answer = pressed(volume)
        assert answer.converged.all()
        assert int(answer.iterations) == 1
        assert_close(answer.displacement, size * straight, rtol=1e-9, atol=1e-12)
    size, shortened = pressed(0.1)
    assert shortened.converged.all()
    assert int(shortened.iterations) > 1
    assert_close(shortened.displacement, size * straight, rtol=1e-6, atol=1e-9)
    limit, _ = pressed(0.0)
    beyond = fem.solve(solver, fem.Load(1.2 * limit * unit, ONE))
    assert float(problem.volume_ratio(1.2 * limit * straight)) < 0
    assert beyond.status.tolist() == [int(fem.Status.NO_VALID_EQUILIBRIUM)]
    assert float(beyond.load_factor) <= 1 / 1.2
    assert float(beyond.load_factor) == pytest.approx(1 / 1.2, abs=0.05)

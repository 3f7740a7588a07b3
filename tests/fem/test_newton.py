"""Laws of the solver: right answers, honest failures, no inverted state, no wasted work."""

import math
import pickle
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from dpl import fem
from dpl.fem.linear import BACKENDS, SuperLU
from dpl.fem.linear.banded import BandedCholesky
from dpl.fem.solvers.factor_reuse import forcing_term

SVK, NH = fem.SaintVenantKirchhoff(0.3), fem.NeoHookeanLn(0.3)
LENGTH = 100.0  # of the paper's beam [m]


def load_of(force: torch.Tensor) -> fem.Load:
    """Return a load of the beam's stiffness."""
    return fem.Load(force, torch.full((len(force),), 4500.0))


def newton(problem: fem.Problem, **options) -> fem.Newton:
    """Return the solver with the backend that every machine has."""
    return fem.Newton(problem, **{"linear": "superlu", **options})


def differing(one: fem.Solution, other: fem.Solution) -> list[str]:
    """Return in what two solutions differ, if only by a bit; the time they took does not count."""
    pairs = zip(fem.Solution._fields, one, other, strict=True)
    return [name for name, a, b in pairs if name != "seconds" and not torch.equal(a, b)]


@pytest.fixture(params=[False, True], ids=["plain", "mixed"])
def mixed(request) -> bool:
    """Both kinds of Newton: without and with mixed integration points."""
    return request.param


# The paper's beam: law, cells, cell, degree, q [Pa], u_z, u_x of the corner [m], iterations
BEAMS = [
    (SVK, (4, 1), "hexahedron", 1, 5, -4.74016, None, None),
    (SVK, (4, 1), "hexahedron", 1, 20, -18.7537, None, None),
    (SVK, (4, 1), "hexahedron", 1, 40, -35.36415, None, None),
    (NH, (4, 1), "hexahedron", 1, 40, -35.3999, None, None),
    (SVK, (8, 2), "hexahedron", 1, 5, -6.3661, None, 4),
    (SVK, (8, 2), "hexahedron", 1, 20, -24.79226, None, 6),
    (SVK, (8, 2), "hexahedron", 1, 40, -44.77862, None, 7),
    (NH, (8, 2), "hexahedron", 1, 40, -44.71446, None, 8),
    (SVK, (16, 4), "hexahedron", 1, 5, -7.06306, None, 4),
    (SVK, (16, 4), "hexahedron", 1, 20, -27.28787, None, 6),
    (SVK, (16, 4), "hexahedron", 1, 40, -48.38715, None, 7),
    (NH, (16, 4), "hexahedron", 1, 40, -48.34221, None, 7),
    (SVK, (4, 1), "hexahedron", 2, 5, -7.20015, None, None),
    (SVK, (4, 1), "hexahedron", 2, 20, -27.72827, None, None),
    (SVK, (4, 1), "hexahedron", 2, 40, -48.8317, None, None),
    (NH, (4, 1), "hexahedron", 2, 40, -48.76971, None, None),
]
FINE_BEAMS = [
    (SVK, (39, 9), "hexahedron", 1, 5, -7.30886, None, 4),
    (SVK, (39, 9), "hexahedron", 1, 20, -28.15840, None, 6),
    (SVK, (39, 9), "hexahedron", 1, 40, -49.62752, -5.92339, 7),
    (NH, (39, 9), "hexahedron", 1, 40, -49.59254, None, None),
    (SVK, (8, 2), "hexahedron", 2, 20, -28.2134, None, None),
    (NH, (8, 2), "hexahedron", 2, 40, -49.65505, None, None),
    (SVK, (16, 4), "hexahedron", 2, 40, -49.88316, -6.03441, None),
    (NH, (16, 4), "hexahedron", 2, 40, -49.8554, None, None),
]


@pytest.mark.parametrize(
    ("law", "cells", "cell", "degree", "q", "z", "x", "count"),
    BEAMS + [pytest.param(*beam, marks=pytest.mark.slow) for beam in FINE_BEAMS],
)
def test_beam_bends_as_tabulated(
    beam, pull, corner, mixed, law, cells, cell, degree, q, z, x, count
):
    """The paper's beam to 1e-6, and the iterations of plain Newton (independent code)."""
    problem = beam(law, *cells, cell=cell, degree=degree)
    backend = "auto" if cells[0] * degree > 16 else "superlu"
    answer = fem.solve(
        newton(problem, linear=backend, mixed_integration=mixed), load_of(pull(problem, q))
    )
    assert answer.converged.all()
    end = corner(problem, answer.displacement) * LENGTH
    assert end[2].item() == pytest.approx(z, rel=1e-6)
    if x is not None:
        assert end[0].item() == pytest.approx(x, rel=1e-6)
    if count is not None:
        assert answer.iterations.item() <= count
        assert mixed or answer.iterations.item() == count


KUHN = [  # The paper's beam: cells, degree, SVK q = 5, 20, 40, NH-ln q = 40
    ((39, 9), 1, [-6.99204, -27.03095, -48.04821, -48.11608]),
    ((8, 2), 2, [-7.29293, -28.08539, -49.46152, -49.50036]),
    ((16, 4), 2, [-7.35097, -28.3029, -49.81862, -49.8045]),
]


@pytest.mark.slow
@pytest.mark.parametrize(("cells", "degree", "printed"), KUHN)
def test_beam_of_tetrahedra_bends_as_tabulated(beam, pull, corner, cells, degree, printed):
    """The paper's beam in six Kuhn tetrahedra per cell; another diagonal: within 0.5 %."""
    for law, q, z in zip([SVK, SVK, SVK, NH], [5, 20, 40, 40], printed, strict=True):
        problem = beam(law, *cells, cell="tetra", degree=degree)
        answer = fem.solve(newton(problem, linear="auto"), load_of(pull(problem, q)))
        end = corner(problem, answer.displacement) * LENGTH
        assert answer.converged.all()
        assert end[2].item() == pytest.approx(z, rel=5e-3)


@pytest.mark.parametrize(("law", "q"), [(SVK, 5), (SVK, 20), (NH, 5)])
def test_residual_falls_with_the_second_order(beam, pull, law, q):
    """The last three residuals above rounding give an order of 1.9 or more."""
    states = newton(beam(law), tol=1e-10).iterate(load_of(pull(beam(law), q)))
    a, b, c = [s.residual.item() for s in states if s.residual > 1e-11][-3:]
    assert math.log(c / b) / math.log(b / a) >= 1.9


def test_one_step_squares_the_error(law, beam, pull):
    """Half the error in the guess leaves a quarter of the error after one iteration."""
    problem = beam(law)
    load = load_of(pull(problem, 20.0))
    answer = fem.solve(newton(problem, tol=1e-12), load).displacement
    left = []
    for error in (1e-3, 5e-4, 2.5e-4):
        states = newton(problem, mixed_integration=False).iterate(load, guess=(1 + error) * answer)
        next(states)
        left.append((next(states).displacement - answer).norm() / (error * answer.norm()))
    assert left[0] < 0.1
    assert [(a / b).item() for a, b in pairwise(left)] == pytest.approx([2.0, 2.0], rel=0.02)


@pytest.mark.parametrize("length", [1e-3, 1.0, 1e3, 100.0])
@pytest.mark.parametrize(
    ("law", "printed"),
    [
        (SVK, [8.023468838e-3, -2.392426382e-4, -0.2479226415]),
        (NH, [1.024683172e-2, -2.397967447e-4, -0.2477360716]),
    ],
    ids=["svk", "neo-hookean"],
)
def test_answer_does_not_depend_on_the_size_of_the_body(pull, corner, law, printed, length):
    """The same u/L in six iterations at q/E = 20/4500, for any E and L."""
    mesh = fem.box([length, length / 4, length / 4], [9, 3, 3])
    problem = fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"))
    answer = fem.solve(
        newton(problem, mixed_integration=False, factor_reuse_tol=0.0), load_of(pull(problem, 20.0))
    )
    assert problem.length == pytest.approx(length)
    assert corner(problem, answer.displacement).tolist() == pytest.approx(printed, rel=1e-9)
    assert answer.iterations.item() == 6


def test_tiny_loads_converge_to_the_linear_answer(law, beam, pull, corner):
    """Stress case T6: u / q is constant; the deviation is linear in q."""
    problem, loads, deviations = beam(law), (1e-2, 1e-4, 1e-6), []
    for q in loads:
        load = load_of(pull(problem, q))
        answer = fem.solve(newton(problem), load)
        linear = fem.solve(fem.LinearSolver(problem, linear="superlu"), load)
        assert answer.converged.all()
        assert answer.iterations.item() <= 2
        ratio = corner(problem, answer.displacement)[2] / corner(problem, linear.displacement)[2]
        deviations.append(abs(ratio.item() - 1))
    assert deviations[1] < 1e-6
    assert deviations[0] / loads[0] == pytest.approx(deviations[1] / loads[1], rel=0.01)
    assert deviations[1] / loads[1] == pytest.approx(deviations[2] / loads[2], rel=0.01)


def test_no_load_costs_nothing(law, beam, monkeypatch):
    """Stress case T6: zero load, u = 0, 0 iterations, no factor."""
    problem = beam(law)
    monkeypatch.setattr(SuperLU, "factorise", None)
    states = list(newton(problem).iterate(load_of(torch.zeros(1, *problem.shape).double())))
    assert len(states) == 1
    assert not states[0].displacement.any()
    assert states[0].converged.all()
    assert states[0].iterations.item() == states[0].factorisations.item() == 0
    assert states[0].load_factor.item() == 1


@pytest.mark.parametrize(
    ("law", "deepest", "volume"), [(SVK, None, 0.720), (NH, -0.7239, 0.804)], ids=["T1", "T3"]
)
def test_four_times_the_training_load_converges(beam, pull, mixed, law, deepest, volume):
    """Stress cases T1 and T3, q = 80 on hex8 16 x 4 x 4."""
    problem = beam(law, 16, 4)
    answer = fem.solve(newton(problem, mixed_integration=mixed), load_of(pull(problem, 80.0)))
    assert answer.converged.all()
    assert answer.volume_ratio.item() == pytest.approx(volume, abs=5e-4)
    if deepest is not None:
        assert answer.displacement[..., 2].min().item() == pytest.approx(deepest, abs=5e-5)


@pytest.mark.parametrize(
    ("q", "deepest", "volume"),
    [
        (160.0, -0.9179, 0.723),
        pytest.param(400.0, -1.1102, 0.590, marks=pytest.mark.slow),
        pytest.param(1000.0, -1.3502, 0.443, marks=pytest.mark.slow),
    ],
)
def test_neo_hookean_beam_answers_any_load(beam, pull, mixed, q, deepest, volume):
    """Stress case T4."""
    problem = beam(NH, 16, 4)
    for state in newton(problem, mixed_integration=mixed).iterate(load_of(pull(problem, q))):
        assert state.volume_ratio.item() > 0
    assert state.converged.all()
    assert state.load_factor.item() == 1
    assert state.displacement[..., 2].min().item() == pytest.approx(deepest, abs=1e-4)
    assert state.volume_ratio.item() == pytest.approx(volume, abs=1e-3)


@pytest.mark.slow
def test_slender_beam_needs_load_steps_and_gets_there(pull):
    """Stress case T5: NH-ln 20 x 1 x 1, nu = 0, hex27, P L^2 / EI = 1: w / L = .302130893."""
    mesh = fem.box([20.0, 1.0, 1.0], [21, 2, 2])
    problem = fem.Problem.build(mesh, fem.NeoHookeanLn(0.0), fixed=fem.Plane(0, "min"), degree=2)
    answer = fem.solve(newton(problem, linear="auto"), load_of(pull(problem, 4500.0 / 12 / 400)))
    assert answer.converged.all()
    end = problem.points[:, 0] == problem.points[:, 0].max()
    force = pull(problem, 1.0)[0, end, 2]
    sag = (answer.displacement[0, end, 2] * force).sum() / force.sum()  # mean over the section
    assert -sag.item() == pytest.approx(0.302130893, rel=1e-3)


def check_defeat(problem: fem.Problem, solver: fem.Newton, force: torch.Tensor) -> None:
    """Assert that a load without an answer ends as stress case T2 requires."""
    for state in solver.iterate(load_of(force)):
        assert state.volume_ratio.item() > 0
        assert state.residual.isfinite().all()
        assert not state.converged.any()
    assert state.status.item() == fem.Status.NO_VALID_EQUILIBRIUM
    factor = state.load_factor.item()
    assert 0 < factor < 1
    rest = fem.evaluate_solution(
        problem, state.displacement, load_of(factor * force), solver.intermediate_tol
    )
    assert rest.converged.all()
    assert state.residual.item() == problem.relative_residual(state.displacement, force).item()


@pytest.mark.parametrize("q", [400.0, 1000.0])
def test_load_without_an_answer_is_reported_with_the_part_that_has_one(beam, pull, mixed, q):
    """Stress case T2: SVK far beyond its limit."""
    problem = beam(SVK)
    solver = newton(problem, min_load_step=2.0**-6, mixed_integration=mixed)
    check_defeat(problem, solver, pull(problem, q))


@pytest.mark.parametrize("most", [3, 4])
def test_a_load_step_is_at_most_twice_the_one_before(most):
    """With few iterations a step a load is applied in many; those that succeed are doubled."""
    problem = fem.Problem.build(fem.box([4.0, 1.0, 1.0], [9, 3, 3]), NH, fixed=fem.Plane(0, "min"))
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -2e-2]).on(problem)[None]
    states = list(newton(problem, max_iter=most, mixed_integration=False).iterate(load_of(force)))
    assert states[-1].converged.all()
    factors = list(dict.fromkeys(state.load_factor.item() for state in states))
    parts = [b - a for a, b in pairwise(factors)]
    assert len(parts) >= 5
    assert all(0 < following <= 2 * part for part, following in pairwise(parts))
    assert any(following == 2 * part for part, following in pairwise(parts))
    assert factors[0] == 0
    assert factors[-1] == 1
    whole = fem.solve(newton(problem), load_of(force))
    assert_close(states[-1].displacement, whole.displacement, rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("q", [160.0, 400.0, 1000.0])
def test_load_without_an_answer_on_the_finer_mesh_is_reported(beam, pull, mixed, q):
    """Stress case T2 on hex8 16 x 4 x 4."""
    problem = beam(SVK, 16, 4)
    check_defeat(problem, newton(problem, mixed_integration=mixed), pull(problem, q))


def test_squeezed_block_fails_where_its_law_softens(mixed):
    """An SVK bar has a solution up to |P| = E / (3 sqrt 3), and none beyond (closed form)."""
    mesh = fem.box([1.0, 1.0, 1.0], [2, 2, 2])
    slides = mesh.p.T == 0  # each coordinate plane holds its own normal
    problem = fem.Problem.build(mesh, SVK, fixed=slides, length=1.0)
    force = torch.zeros(1, 8, 3, dtype=torch.float64)
    force[0, torch.from_numpy(mesh.p[0] == 1), 0] = -1 / 4
    limit = 1 / (3 * math.sqrt(3))
    below = fem.solve(newton(problem, mixed_integration=mixed), load_of(0.99 * limit * force))
    assert below.converged.all()
    assert below.displacement[0, :, 0].min().item() + 1 > 1 / math.sqrt(3)
    above = fem.solve(newton(problem, mixed_integration=mixed), load_of(1.05 * limit * force))
    assert not above.converged.any()
    assert above.volume_ratio.item() > 0
    assert above.load_factor.item() == pytest.approx(1 / 1.05, abs=0.02)


def test_batch_solves_like_its_members(law, beam, pull):
    """Members that need 0, 2, 4, 7 or no end of iterations do not disturb each other."""
    problem = beam(law, 4, 1)
    force = torch.cat([pull(problem, q) for q in (0.0, 1e-3, 5.0, 40.0, 2000.0)])
    solver = newton(problem, min_load_step=2.0**-4)
    batch = fem.solve(solver, load_of(force))
    for k, alone in enumerate(force):
        member = fem.solve(solver, load_of(alone[None]))
        assert differing(fem.Solution(*(value[k, None] for value in batch)), member) == []
    assert len(set(batch.iterations.tolist())) == 5


def test_states_are_yielded_from_the_start_one_by_one(law, beam, pull):
    problem = beam(law)
    states = list(newton(problem).iterate(load_of(pull(problem, 20.0))))
    assert not states[0].displacement.any()
    assert states[0].residual.item() == 1
    assert [s.iterations.item() for s in states] == list(range(len(states)))
    assert [s.converged.item() for s in states] == [False] * (len(states) - 1) + [True]
    assert [s.load_factor.item() for s in states] == [0.0] * (len(states) - 1) + [1.0]
    for state in states:
        again = fem.evaluate_solution(
            problem, state.displacement, load_of(pull(problem, 20.0)), 1e-8
        )
        assert torch.equal(again.residual, state.residual)
        assert torch.equal(again.volume_ratio, state.volume_ratio)


@pytest.fixture
def wrong(law, beam, pull) -> tuple[fem.Problem, fem.Load, fem.Solution]:
    """A problem, its load and its answer from zero."""
    problem = beam(law)
    load = load_of(pull(problem, 20.0))
    return problem, load, fem.solve(newton(problem), load)


@pytest.mark.parametrize("kind", ["nan", "one nan", "infinite", "inverted", "huge"])
def test_bad_guess_changes_no_bit_of_the_answer(wrong, kind):
    """Stress case T19."""
    problem, load, answer = wrong
    guess = torch.zeros_like(load.force)
    if kind == "nan":
        guess += math.nan
    elif kind == "one nan":
        guess[0, -1, 1] = math.nan
    elif kind == "infinite":
        guess += math.inf
    elif kind == "inverted":
        guess += problem.points * torch.tensor([-1.5, 0, 0], dtype=torch.float64)
    else:
        guess += 1e200 * torch.sin(1e3 * problem.points)
    *_, again = newton(problem).iterate(load, guess=guess)
    assert differing(again, answer) == []


def test_useless_but_uninverted_guess_still_ends_at_the_answer(wrong):
    problem, load, answer = wrong
    random = torch.Generator().manual_seed(0)
    noise = 5e-3 * torch.randn(load.force.shape, generator=random, dtype=torch.float64)
    assert problem.volume_ratio(noise).item() > 0
    for guess in (noise, -answer.displacement, 0.5 * answer.displacement):
        *_, end = newton(problem).iterate(load, guess=guess)
        assert end.converged.all()
        assert_close(end.displacement, answer.displacement, rtol=0, atol=1e-8)


def test_newton_takes_whole_steps_from_a_guess_or_gives_it_up(wrong):
    """A guess of which a step must be shortened is none: its steps solve the linearised system."""
    problem, load, answer = wrong
    random = torch.Generator().manual_seed(0)
    noise = torch.randn(load.force.shape, generator=random, dtype=torch.float64)
    kept = given_up = 0
    for size in (1e-4, 1e-3, 3e-3, 1e-2, 2e-2, 3e-2):
        guess = answer.displacement + size * torch.where(problem.free, noise, 0.0)
        states = list(
            newton(problem, mixed_integration=False, factor_reuse_tol=0.0).iterate(
                load, guess=guess
            )
        )
        assert states[-1].converged.all()
        for state, end in pairwise(states):
            if not (state.from_guess and end.from_guess):
                given_up += int(state.from_guess.item() and not end.from_guess.item())
                continue
            u, step = state.displacement, end.displacement - state.displacement
            before = problem.residual(u, load.force)
            after = before + problem.tangent_product(u, step)
            assert after[:, problem.free].norm() < 1e-2 * before.norm()
            kept += 1
    assert kept > 10
    assert given_up > 0


def test_exact_guess_costs_nothing(wrong, monkeypatch):
    """No assembly and no factorisation."""
    problem, load, answer = wrong
    monkeypatch.setattr(SuperLU, "factorise", None)
    monkeypatch.setattr(fem.Problem, "tangent", None)
    monkeypatch.setattr(fem.Problem, "linearise", None)
    states = list(newton(problem).iterate(load, guess=answer.displacement))
    assert len(states) == 1
    assert states[0].converged.all()
    assert states[0].iterations.item() == states[0].factorisations.item() == 0
    assert torch.equal(states[0].displacement, answer.displacement)


def test_close_guess_saves_iterations(wrong):
    problem, load, answer = wrong
    *_, end = newton(problem).iterate(load, guess=1.0001 * answer.displacement)
    assert end.converged.all()
    assert 0 < end.iterations.item() < answer.iterations.item()


def test_guess_of_the_held_nodes_is_not_believed(wrong):
    problem, load, answer = wrong
    guess = answer.displacement + torch.where(problem.free, 0.0, 0.1)
    *_, end = newton(problem).iterate(load, guess=guess)
    assert end.iterations.item() == 0
    assert not end.displacement[:, ~problem.free].any()


def test_members_use_their_own_guess(law, beam, pull):
    problem = beam(law, 4, 1)
    load = load_of(torch.cat([pull(problem, q) for q in (5.0, 20.0, 40.0)]))
    answer = fem.solve(newton(problem), load)
    guess = answer.displacement.clone()
    guess[1] = math.nan
    *_, end = newton(problem).iterate(load, guess=guess)
    assert end.converged.all()
    assert end.iterations.tolist() == [0, answer.iterations[1].item(), 0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda force: force.float(), "dtype"),
        (lambda force: force.long(), "dtype"),
        (lambda force: force[0], "shape"),
        (lambda force: force[:, 1:], "shape"),
        (lambda force: force[..., 1:], "shape"),
        (lambda force: force[:0], "shape"),
    ],
    ids=["single", "whole", "no batch", "nodes", "axes", "none"],
)
def test_force_of_another_kind_or_shape_is_an_error_that_says_so(beam, pull, change, message):
    problem = beam(NH, 2, 1)
    solver, load = newton(problem), load_of(change(pull(problem, 20.0)))
    for each in (solver, solver.linear_solver):
        with pytest.raises(ValueError, match=rf"force\.{message} = "):
            fem.solve(each, load)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("amplitude", [1e-12, 20.0])
def test_force_that_is_no_number_has_no_answer_even_on_a_held_node(beam, pull, bad, amplitude):
    problem = beam(NH, 2, 1)
    load = load_of(pull(problem, amplitude))
    held = int((~problem.free).any(dim=1).nonzero()[0, 0])
    load.force[0, held, 0] = bad
    solver = newton(problem)
    for each in (solver, solver.linear_solver):
        assert not fem.solve(each, load).converged.any()


@pytest.mark.parametrize(
    "option",
    [
        *(
            {name: value}
            for name in ("tol", "intermediate_tol", "min_detF_ratio", "min_load_step")
            for value in (0, 1)
        ),
        *(
            {"tol": -1e-8},
            {"tol": math.nan},
            {"max_iter": 0},
            {"max_iter": -3},
            {"max_total_iter": 0},
        ),
    ],
    ids=str,
)
def test_option_out_of_range_is_an_error_that_names_it(beam, option):
    with pytest.raises(ValueError, match=next(iter(option))):
        fem.Newton(beam(NH, 4, 1), **option)


def test_unknown_backend_is_an_error(beam, pull):
    problem = beam(NH, 4, 1)
    with pytest.raises(ValueError, match="linear = "):
        fem.solve(newton(problem, linear="umfpack"), load_of(pull(problem, 1.0)))


def test_rest_state_is_factorised_once_for_all_loads(law, beam, pull, counted):
    """The factor of K(0) belongs to the scene and is not counted."""
    problem = beam(law)
    solver, load = newton(problem, factor_reuse_tol=0.0), load_of(pull(problem, 20.0))
    first = fem.solve(solver, load)
    assert first.factorisations.item() == first.iterations.item() - 1
    assert len(counted) == first.iterations.item()
    counted.clear()
    second = fem.solve(solver, load)
    assert len(counted) == second.factorisations.item() == first.factorisations.item()
    assert torch.equal(first.displacement, second.displacement)


def test_load_whose_linear_answer_will_do_costs_no_factorisation(law, beam, pull, counted):
    problem = beam(law)
    solver = newton(problem)
    for q in (1e-10, 2e-10, 3e-10):
        answer = fem.solve(solver, load_of(pull(problem, q)))
        assert answer.converged.all()
        assert answer.iterations.item() == 1
        assert answer.factorisations.item() == 0
    assert len(counted) == 1  # the rest state


def test_linear_answer_is_the_first_iterate(law, beam, pull):
    problem = beam(law)
    load = load_of(pull(problem, 5.0))
    states = list(newton(problem).iterate(load))
    linear = fem.solve(fem.LinearSolver(problem, linear="superlu"), load)
    assert torch.equal(linear.displacement, states[1].displacement)
    assert torch.equal(linear.residual, states[1].residual)
    assert not linear.converged.any()
    assert linear.iterations.item() == 1


@pytest.mark.parametrize("name", [name for name in BACKENDS if name != "superlu"])
def test_backends_give_the_same_answer(law, beam, pull, name):
    if name not in fem.installed_backends():
        pytest.skip(f"{name} is not installed")
    problem = beam(law)
    load = load_of(pull(problem, 20.0))
    first, second = (fem.solve(newton(problem, linear=one), load) for one in ("superlu", name))
    assert second.converged.all()
    more = second.iterations.item() - first.iterations.item()  # iterative solves are less exact
    assert more == 0 or (name in ("band32", "cg") and abs(more) == 1)
    assert_close(first.displacement, second.displacement, rtol=0, atol=1e-9)


def test_solver_without_pardiso_solves_the_same(beam, pull, monkeypatch):
    problem = beam(NH, 4, 1)
    load = load_of(pull(problem, 20.0))
    expected = fem.solve(newton(problem), load)
    monkeypatch.setattr("dpl.fem.linear.backends.installed_backends", lambda: ["superlu"])
    assert torch.equal(fem.solve(fem.Newton(problem), load).displacement, expected.displacement)


@pytest.mark.parametrize("q", [5.0, 20.0, 40.0])
def test_mixed_points_find_the_same_answer_in_fewer_iterations(law, beam, pull, q):
    """Magisano, Leonetti, Garcea (2017)."""
    problem = beam(law)
    load = load_of(pull(problem, q))
    plain, mixed = (
        fem.solve(newton(problem, tol=1e-10, mixed_integration=m), load) for m in (False, True)
    )
    assert plain.converged.all()
    assert mixed.converged.all()
    assert_close(mixed.displacement, plain.displacement, rtol=0, atol=1e-9)
    assert mixed.iterations.item() <= plain.iterations.item() - (q > 10)


@dataclass(frozen=True)
class EnergyOnly(fem.YoungPoissonMaterial):
    """The Saint Venant-Kirchhoff law as a user would write it: its energy alone."""

    def energy(self, H):
        """Return the energy density."""
        return fem.SaintVenantKirchhoff.energy(self, H)


def test_law_that_is_only_an_energy_solves_like_its_closed_form(beam, pull):
    problem, short = beam(SVK, 4, 1), beam(EnergyOnly(0.3), 4, 1)
    load = load_of(pull(problem, 20.0))
    answer, again = fem.solve(newton(problem), load), fem.solve(newton(short), load)
    assert again.converged.all()
    assert_close(again.displacement, answer.displacement, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", [fem.Newton, fem.LinearSolver])
def test_pickled_solver_answers_the_same(beam, pull, kind):
    problem = beam(NH, 4, 1)
    load = load_of(pull(problem, 5.0))
    solver = kind(problem, tol=1e-9, linear="superlu")
    answer = fem.solve(solver, load)
    copy = pickle.loads(pickle.dumps(solver))  # after factors have been made
    assert copy.tol == 1e-9
    assert torch.equal(fem.solve(copy, load).displacement, answer.displacement)


def test_moved_supports_pull_the_body_along(law, mixed):
    """A bar stretched by its ends has the closed-form lateral stretch at 1.5."""
    mesh = fem.box([1.0, 1.0, 1.0], [3, 3, 3])
    held = mesh.p.T == 0
    held[:, 0] |= mesh.p[0] == 1
    given = np.where(mesh.p[0] == 1, 0.5, 0.0)[:, None] * np.array([1, 0, 0])
    problem = fem.Problem.build(mesh, law, fixed=held, prescribed=given, length=1.0)
    none = torch.zeros(1, *problem.shape, dtype=torch.float64)
    answer = fem.solve(newton(problem, tol=1e-12, mixed_integration=mixed), load_of(none))
    assert answer.converged.all()
    assert answer.load_factor.item() == 1
    far = problem.points.sum(dim=1).argmax()
    lateral = {fem.SaintVenantKirchhoff: 0.79056942, fem.NeoHookeanLn: 0.88017459}[type(law)]
    end = 1 + answer.displacement[0, far]
    assert end.tolist() == pytest.approx([1.5, lateral, lateral], abs=6e-9)


def test_judge_believes_nothing(law, beam, pull):
    problem = beam(law, 4, 1)
    load = load_of(torch.cat([pull(problem, 20.0)] * 3))
    claims = torch.zeros_like(load.force)
    claims[1] = fem.solve(newton(problem), load_of(load.force[:1])).displacement[0]
    claims[2] = math.nan
    verdict = fem.evaluate_solution(problem, claims, load, 1e-8, iterations=3)
    assert verdict.converged.tolist() == [False, True, False]
    assert verdict.load_factor.tolist() == [0, 1, 0]
    assert verdict.iterations.tolist() == [3, 3, 3]
    assert verdict.negative_pivots.tolist() == [-1, -1, -1]  # nobody has looked
    assert verdict.residual[0].item() == pytest.approx(1.0, rel=1e-14)
    assert verdict.volume_ratio[2].item() == -math.inf


@pytest.fixture(scope="module")
def column() -> fem.Problem:
    """A column of 10 x 1 x 1 m: ten hex27 of SVK, nu = 0."""
    mesh = fem.box([10.0, 1.0, 1.0], [11, 2, 2])
    return fem.Problem.build(
        mesh, fem.SaintVenantKirchhoff(0.0), fixed=fem.Plane(0, "min"), degree=2
    )


@pytest.fixture
def squeezed(column) -> Callable[[float], fem.Solution]:
    """Solutions under an axial dead load P, E = 1000 Pa."""

    def squeezed(P: float) -> fem.Solution:
        force = fem.Traction(fem.Plane(0, "max"), [-P / 1000, 0.0, 0.0]).on(column)[None]
        return fem.solve(newton(column), load_of(force))

    return squeezed


def test_column_below_its_critical_load_is_stable(squeezed):
    """K becomes singular at P = 2.039763 (independent code)."""
    answer = squeezed(2.03)
    assert answer.stable.all()
    assert answer.status.item() == fem.Status.CONVERGED
    assert answer.negative_pivots.item() == 0


def test_straight_column_beyond_its_critical_load_is_flagged(squeezed):
    """At P = 2.5 the straight state is an equilibrium with two negative eigenvalues."""
    answer = squeezed(2.5)
    assert answer.converged.all()
    assert not answer.stable.any()
    assert answer.status.item() == fem.Status.UNSTABLE
    assert answer.negative_pivots.item() == 2
    assert 10 * answer.displacement[..., 0].min().item() == pytest.approx(-0.02509, abs=5e-6)


def test_status_reads_as_words():
    assert [str(one) for one in fem.Status] == [
        *("converged", "unstable", "no valid equilibrium", "not converged"),
    ]


@pytest.mark.parametrize("budget", [1, 3])
def test_load_is_given_up_where_the_budget_ends(beam, pull, budget):
    problem = beam(NH)
    answer = fem.solve(newton(problem, max_total_iter=budget), load_of(pull(problem, 40.0)))
    assert answer.status.item() == fem.Status.NOT_CONVERGED
    assert answer.iterations.item() == budget
    assert not answer.converged.any()
    assert answer.load_factor.item() == 0


def test_answer_of_the_last_iteration_of_the_budget_counts(beam, pull):
    problem = beam(NH)
    load = load_of(pull(problem, 20.0))
    answer = fem.solve(newton(problem), load)
    assert answer.converged.all()
    spent = fem.solve(newton(problem, max_total_iter=answer.iterations.item()), load)
    assert differing(spent, answer) == []


def test_time_goes_on(beam, pull):
    states = newton(beam(NH)).iterate(load_of(pull(beam(NH), 20.0)))
    seconds = [state.seconds.item() for state in states]
    assert seconds[0] > 0
    assert all(a < b for a, b in pairwise(seconds))


@pytest.mark.parametrize(
    ("part", "deepest"),
    [(1e-2, -0.2388289), (1e-4, -0.2386176), (1e-6, -0.2386155), (1e-8, -0.2386155)],
)
def test_slivers_end_where_rounding_ends_them(pull, corner, part, deepest):
    """Stress case T11: the plane x = 50 moved to 37.5 + 12.5 eps."""
    mesh = fem.box([LENGTH, 25.0, 25.0], [9, 3, 3])
    points = mesh.p.copy()
    points[0, points[0] == 50.0] = 37.5 + 12.5 * part
    with pytest.warns(UserWarning, match="aspect ratio"):
        problem = fem.Problem.build(type(mesh)(points, mesh.t), SVK, fixed=fem.Plane(0, "min"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        answer = fem.solve(newton(problem), load_of(pull(problem, 20.0)))
    reported = any("rounding allows no less" in str(w.message) for w in caught)
    assert reported == bool(answer.residual > 1e-8) == (part == 1e-8)
    assert answer.converged.all()
    assert corner(problem, answer.displacement)[2].item() == pytest.approx(deepest, abs=6e-8)


def test_linear_solves_are_as_exact_as_eisenstat_and_walker_ask():
    """Choice 2 of Eisenstat and Walker (1996), between 1e-12 and 1e-3."""
    term = partial(forcing_term, tol=1e-15, corotational=False)
    assert term(1e-2, 1e-1) == pytest.approx(0.01 * (1e-2 / 1e-1) ** 2)
    assert term(1.0, 1e-3) == 1e-3
    assert term(1e-3, 1e3) == 1e-12
    assert term(1e-6, 1e3, tol=1e-8) == pytest.approx(1e-3)
    first = float("nan")
    assert term(1.0, first) == 1e-12
    assert term(1.0, first, corotational=True) == 1e-3


def test_stability_is_not_known_before_newton_ends(beam, pull):
    problem = beam(NH, 4, 1)
    states = list(fem.Newton(problem, linear="superlu").iterate(load_of(pull(problem, 20.0))))
    assert [int(state.negative_pivots) for state in states[:-1]] == [-1] * (len(states) - 1)
    assert int(states[-1].negative_pivots) == 0


def test_the_solver_of_another_poissons_ratio_shares_what_does_not_depend_on_it(beam, pull):
    problem = beam(fem.NeoHookeanLn([0.2, 0.4]), 4, 1)
    newton = fem.Newton(problem, linear="superlu", tol=1e-9)
    ratio = torch.tensor([[0.25]], dtype=torch.float64)
    clone = newton.with_parameters(ratio)
    assert clone.tol == 1e-9
    assert clone.problem is problem.with_parameters(ratio)
    assert clone.linear_solver.problem is clone.problem
    assert clone.linear_solver is newton.linear_solver.with_parameters(ratio)
    for name in ("backend", "tangent_backend"):
        assert getattr(clone.linear_solver, name) is getattr(newton.linear_solver, name)


@pytest.mark.parametrize("linear", ["band", "band32", "superlu"])
def test_a_guess_with_an_indefinite_tangent_is_abandoned_if_wanted(linear, monkeypatch):
    """A beam compressed by 40 %: its tangent has negative eigenvalues, those of buckling."""
    problem = fem.Problem.build(
        fem.box([4.0, 1.0, 1.0], [9, 3, 3]), fem.NeoHookeanLn(0.3), fixed=fem.Plane(0, "min")
    )
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, 1e-3]).on(problem)
    load = fem.Load(force[None], torch.ones(1, dtype=torch.float64))
    guess = torch.zeros(1, *problem.shape, dtype=torch.float64)
    guess[..., 0] = -0.4 * (problem.points[:, 0] - problem.points[:, 0].min())
    exact = fem.solve(fem.Newton(problem, linear=linear), load)
    newton = fem.Newton(problem, linear=linear, abandon_indefinite_guess=True)
    if linear != "superlu":  # bands factorise no indefinite matrix themselves
        refused = property(lambda backend: pytest.fail("an indefinite tangent was factorised"))
        monkeypatch.setattr(BandedCholesky, "other", refused)
    states = list(newton.iterate(load, guess=guess))
    assert states[0].from_guess
    assert not states[1].from_guess
    assert states[-1].converged
    assert (states[-1].displacement - exact.displacement).norm() < 1e-6 * exact.displacement.norm()

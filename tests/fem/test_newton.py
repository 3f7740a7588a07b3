"""Laws of the solver: right answers, honest failures, no inverted state, no wasted work."""

import math
import pickle
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product

import pytest
import torch
from solving import LENGTH, load_of, noise, rest
from torch.testing import assert_close

from dpl import fem
from dpl.fem.linear import SuperLU
from dpl.fem.linear.banded import BandedCholesky
from dpl.fem.solvers.factor_reuse import forcing_term

SVK, NH = fem.SaintVenantKirchhoff(0.3), fem.NeoHookeanLn(0.3)


def newton(problem: fem.Problem, **options) -> fem.Newton:
    """Return the solver with the backend that every machine has."""
    return fem.Newton(problem, **{"linear": "superlu", **options})


def differing(one: fem.Solution, other: fem.Solution) -> list[str]:
    """Return in what two solutions differ, if only by a bit; the time they took does not count."""
    pairs = zip(fem.Solution._fields, one, other, strict=True)
    return [name for name, a, b in pairs if name != "seconds" and not torch.equal(a, b)]


# The paper's beam: law, cells, degree, q [Pa], u_z, u_x of the corner [m], iterations
BEAMS = [
    (SVK, (4, 1), 1, 5, -4.74016, None, None),
    (SVK, (4, 1), 1, 20, -18.7537, None, None),
    (SVK, (4, 1), 1, 40, -35.36415, None, None),
    (NH, (4, 1), 1, 40, -35.3999, None, None),
    (SVK, (8, 2), 1, 5, -6.3661, None, 4),
    (SVK, (8, 2), 1, 20, -24.79226, None, 6),
    (SVK, (8, 2), 1, 40, -44.77862, None, 7),
    (NH, (8, 2), 1, 40, -44.71446, None, 8),
    (SVK, (16, 4), 1, 5, -7.06306, None, 4),
    (SVK, (16, 4), 1, 20, -27.28787, None, 6),
    (SVK, (16, 4), 1, 40, -48.38715, None, 7),
    (NH, (16, 4), 1, 40, -48.34221, None, 7),
    (SVK, (4, 1), 2, 5, -7.20015, None, None),
    (SVK, (4, 1), 2, 20, -27.72827, None, None),
    (SVK, (4, 1), 2, 40, -48.8317, None, None),
    (NH, (4, 1), 2, 40, -48.76971, None, None),
]
FINE_BEAMS = [
    (SVK, (39, 9), 1, 5, -7.30886, None, 4),
    (SVK, (39, 9), 1, 20, -28.15840, None, 6),
    (SVK, (39, 9), 1, 40, -49.62752, -5.92339, 7),
    (NH, (39, 9), 1, 40, -49.59254, None, None),
    (SVK, (8, 2), 2, 20, -28.2134, None, None),
    (NH, (8, 2), 2, 40, -49.65505, None, None),
    (SVK, (16, 4), 2, 40, -49.88316, -6.03441, None),
    (NH, (16, 4), 2, 40, -49.8554, None, None),
]


@pytest.mark.parametrize(
    ("law", "cells", "degree", "q", "z", "x", "count", "mixed"),
    [(*beam, False) for beam in BEAMS]
    + [(*beam, True) for beam in BEAMS if beam[1] == (8, 2)]
    + [
        pytest.param(*beam, mixed, marks=pytest.mark.slow)
        for beam in FINE_BEAMS
        for mixed in (False, True)
    ],
)
def test_beam_bends_as_tabulated(beam, pull, corner, law, cells, degree, q, z, x, count, mixed):
    """The paper's beam to 1e-6, and the iterations of plain Newton (independent code)."""
    problem = beam(law, *cells, degree=degree)
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


def test_no_load_costs_nothing(beam, monkeypatch):
    """Stress case T6: zero load, u = 0, 0 iterations, no factor."""
    problem = beam(NH)
    monkeypatch.setattr(SuperLU, "factorise", None)
    states = list(newton(problem).iterate(load_of(rest(problem))))
    assert len(states) == 1
    assert not states[0].displacement.any()
    assert states[0].converged.all()
    assert states[0].iterations.item() == states[0].factorisations.item() == 0
    assert states[0].load_factor.item() == 1


def test_a_load_step_is_at_most_twice_the_one_before():
    """With few iterations a step a load is applied in many; those that succeed are doubled."""
    problem = fem.Problem.build(fem.box([4.0, 1.0, 1.0], [9, 3, 3]), NH, fixed=fem.Plane(0, "min"))
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -2e-2]).on(problem)[None]
    states = list(newton(problem, max_iter=4, mixed_integration=False).iterate(load_of(force)))
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


def test_batch_solves_like_its_members(beam, pull):
    """Members that need 0, 2, 4, 7 or no end of iterations do not disturb each other."""
    problem = beam(SVK, 4, 1)
    force = torch.cat([pull(problem, q) for q in (0.0, 1e-3, 5.0, 40.0, 2000.0)])
    solver = newton(problem, min_load_step=2.0**-4)
    batch = fem.solve(solver, load_of(force))
    for k, alone in enumerate(force):
        member = fem.solve(solver, load_of(alone[None]))
        assert differing(fem.Solution(*(value[k, None] for value in batch)), member) == []
    assert len(set(batch.iterations.tolist())) == 5


def test_states_are_yielded_from_the_start_one_by_one(beam, pull):
    problem = beam(NH)
    load = load_of(pull(problem, 20.0))
    states = list(newton(problem).iterate(load))
    assert not states[0].displacement.any()
    assert states[0].residual.item() == 1
    assert [s.iterations.item() for s in states] == list(range(len(states)))
    assert [s.converged.item() for s in states] == [False] * (len(states) - 1) + [True]
    assert [s.load_factor.item() for s in states] == [0.0] * (len(states) - 1) + [1.0]
    assert [s.negative_pivots.item() for s in states] == [-1] * (len(states) - 1) + [0]
    seconds = [s.seconds.item() for s in states]
    assert seconds[0] > 0
    assert all(a < b for a, b in pairwise(seconds))
    for state in states:
        again = fem.evaluate_solution(problem, state.displacement, load, 1e-8)
        assert torch.equal(again.residual, state.residual)
        assert torch.equal(again.volume_ratio, state.volume_ratio)
    linear = fem.solve(fem.LinearSolver(problem, linear="superlu"), load)
    assert torch.equal(linear.displacement, states[1].displacement)
    assert torch.equal(linear.residual, states[1].residual)
    assert not linear.converged.any()
    assert linear.iterations.item() == 1


@pytest.fixture(scope="module")
def wrong(beam, pull) -> tuple[fem.Problem, fem.Load, fem.Solution]:
    """A problem, its load and its answer from zero."""
    problem = beam(NH)
    load = load_of(pull(problem, 20.0))
    return problem, load, fem.solve(newton(problem), load)


@pytest.mark.parametrize("kind", ["one nan", "infinite", "inverted", "huge"])
def test_bad_guess_changes_no_bit_of_the_answer(wrong, kind):
    """Stress case T19."""
    problem, load, answer = wrong
    guess = torch.zeros_like(load.force)
    if kind == "one nan":
        guess[0, -1, 1] = math.nan
    else:
        guess += {
            "infinite": torch.tensor(math.inf),
            "inverted": problem.points * torch.tensor([-1.5, 0, 0], dtype=torch.float64),
            "huge": 1e200 * torch.sin(1e3 * problem.points),
        }[kind]
    *_, again = newton(problem).iterate(load, guess=guess)
    assert differing(again, answer) == []


def test_useless_but_uninverted_guess_still_ends_at_the_answer(wrong):
    problem, load, answer = wrong
    small = 5e-3 * noise(*load.force.shape)
    assert problem.volume_ratio(small).item() > 0
    for guess in (small, -answer.displacement, 0.5 * answer.displacement):
        *_, end = newton(problem).iterate(load, guess=guess)
        assert end.converged.all()
        assert_close(end.displacement, answer.displacement, rtol=0, atol=1e-8)


def test_newton_takes_whole_steps_from_a_guess_or_gives_it_up(wrong):
    """A guess of which a step must be shortened is none: its steps solve the linearised system."""
    problem, load, answer = wrong
    way = torch.where(problem.free, noise(*load.force.shape), 0.0)
    kept = given_up = 0
    plain = newton(problem, mixed_integration=False, factor_reuse_tol=0.0)
    for size in (1e-3, 3e-3, 1e-2, 3e-2):
        states = list(plain.iterate(load, guess=answer.displacement + size * way))
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
    assert kept > 6
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


def test_close_guess_saves_iterations_and_its_held_nodes_are_not_believed(wrong):
    problem, load, answer = wrong
    guess = 1.0001 * answer.displacement + torch.where(problem.free, 0.0, 0.1)
    *_, end = newton(problem).iterate(load, guess=guess)
    assert end.converged.all()
    assert 0 < end.iterations.item() < answer.iterations.item()
    assert not end.displacement[:, ~problem.free].any()


def test_members_use_their_own_guess(beam, pull):
    problem = beam(NH, 4, 1)
    load = load_of(torch.cat([pull(problem, q) for q in (5.0, 20.0, 40.0)]))
    answer = fem.solve(newton(problem), load)
    guess = answer.displacement.clone()
    guess[1] = math.nan
    *_, end = newton(problem).iterate(load, guess=guess)
    assert end.converged.all()
    assert end.iterations.tolist() == [0, answer.iterations[1].item(), 0]


def test_force_of_another_kind_or_shape_is_an_error_that_says_so(beam, pull):
    problem = beam(NH, 2, 1)
    force, solver = pull(problem, 20.0), newton(problem)
    others = force[0], force[:, 1:], force[..., 1:], force[:0]
    wrong = [("dtype", force.float()), ("dtype", force.long()), *(("shape", one) for one in others)]
    for name, given in wrong:
        for each in (solver, solver.linear_solver):
            with pytest.raises(ValueError, match=rf"force\.{name} = "):
                fem.solve(each, load_of(given))


@pytest.mark.parametrize(("bad", "amplitude"), [(math.nan, 20.0), (math.inf, 1e-12)])
def test_force_that_is_no_number_has_no_answer_even_on_a_held_node(beam, pull, bad, amplitude):
    problem = beam(NH, 2, 1)
    load = load_of(pull(problem, amplitude))
    held = int((~problem.free).any(dim=1).nonzero()[0, 0])
    load.force[0, held, 0] = bad
    solver = newton(problem)
    for each in (solver, solver.linear_solver):
        assert not fem.solve(each, load).converged.any()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *product(("tol", "intermediate_tol", "min_detF_ratio", "min_load_step"), (0, 1)),
        *(("tol", -1e-8), ("tol", math.nan), ("max_iter", 0), ("max_iter", -3)),
        *(("max_total_iter", 0), ("linear", "umfpack")),
        *(("factor_reuse_tol", tol) for tol in (-0.1, -1e-300, math.nan, math.inf)),
    ],
)
def test_option_out_of_range_is_an_error_that_names_it(beam, name, value):
    with pytest.raises(ValueError, match=f"{name} = "):
        fem.Newton(beam(NH, 4, 1), **{name: value}).linear_solver.backend  # noqa: B018


def test_rest_state_is_factorised_once_for_all_loads(beam, pull, counted):
    """The factor of K(0) belongs to the scene and is not counted."""
    problem = beam(NH)
    solver, load = newton(problem, factor_reuse_tol=0.0), load_of(pull(problem, 20.0))
    first = fem.solve(solver, load)
    assert first.factorisations.item() == first.iterations.item() - 1
    assert len(counted) == first.iterations.item()
    counted.clear()
    second = fem.solve(solver, load)
    assert len(counted) == second.factorisations.item() == first.factorisations.item()
    assert torch.equal(first.displacement, second.displacement)


def test_load_whose_linear_answer_will_do_costs_no_factorisation(beam, pull, counted):
    problem = beam(NH)
    solver = newton(problem)
    for q in (1e-10, 2e-10, 3e-10):
        answer = fem.solve(solver, load_of(pull(problem, q)))
        assert answer.converged.all()
        assert answer.iterations.item() == 1
        assert answer.factorisations.item() == 0
    assert len(counted) == 1  # the rest state


@pytest.mark.parametrize("name", sorted({*fem.installed_backends()} - {"superlu"}))
def test_backends_give_the_same_answer(wrong, name):
    problem, load, first = wrong
    second = fem.solve(newton(problem, linear=name), load)
    assert second.converged.all()
    more = second.iterations.item() - first.iterations.item()  # iterative solves are less exact
    assert more == 0 or (name in ("band32", "cg") and abs(more) == 1)
    assert_close(first.displacement, second.displacement, rtol=0, atol=1e-9)


@pytest.mark.parametrize("q", [5.0, 40.0])
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


def test_judge_believes_nothing(beam, pull):
    problem = beam(NH, 4, 1)
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


def test_status_reads_as_words():
    words = ["converged", "unstable", "no valid equilibrium", "not converged"]
    assert [str(one) for one in fem.Status] == words


def test_load_is_given_up_where_the_budget_ends_and_its_last_iteration_counts(wrong):
    problem, load, whole = wrong
    count = whole.iterations.item()
    for budget in (1, count - 1):
        answer = fem.solve(newton(problem, max_total_iter=budget), load)
        assert answer.status.item() == fem.Status.NOT_CONVERGED
        assert answer.iterations.item() == budget
        assert not answer.converged.any()
        assert answer.load_factor.item() == 0
    assert differing(fem.solve(newton(problem, max_total_iter=count), load), whole) == []


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
    load = load_of(force[None])
    guess = rest(problem)
    guess[..., 0] = -0.4 * (problem.points[:, 0] - problem.points[:, 0].min())
    exact = fem.solve(fem.Newton(problem, linear=linear), load)
    newton = fem.Newton(problem, linear=linear, abandon_indefinite_guess=True)
    if linear != "superlu":  # bands factorise no indefinite matrix themselves
        refused = property(lambda backend: pytest.fail("an indefinite tangent was factorised"))
        monkeypatch.setattr(BandedCholesky, "indefinite", refused)
    states = list(newton.iterate(load, guess=guess))
    assert states[0].from_guess
    assert not states[1].from_guess
    assert states[-1].converged
    assert (states[-1].displacement - exact.displacement).norm() < 1e-6 * exact.displacement.norm()

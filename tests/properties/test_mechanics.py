"""What holds for any body, law, support and load: laws of mechanics, and what solvers promise."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from bodies import (
    HELD,
    bent,
    bodies,
    cases,
    gradients,
    laws,
    load_of,
    logarithmic,
    pushes,
    rotation,
    seeds,
)
from bounds import at_most
from hypothesis import assume, given
from hypothesis import strategies as st
from torch import Tensor

from dpl import fem
from dpl.fem.linear import full_matrix

# Very thin, nearly incompressible cells: said in words, and answers are held to what it says.
pytestmark = pytest.mark.filterwarnings("ignore:.*rounding allows no less:UserWarning")

EPS = float(torch.finfo(torch.float64).eps)
FREE = ("free",)
UNMOVED = tuple(set(HELD) - {"moved"})
steepnesses = logarithmic(1e-9, 0.6)  # largest |H|: nothing is inverted below 1


def slack(problem: fem.Problem, *displacements: Tensor) -> Tensor:
    """Return by how much rounding may change a nodal force at any of some displacements, (B,).

    `Problem.roundoff_bound` is a sum of magnitudes with the moduli at rest; a thousand times that
    leaves room for those of steep laws at |H| = 0.6. It is still some 1e-11 of what acts.
    """
    return 1000 * torch.stack([problem.roundoff_bound(u) for u in displacements]).amax(dim=0)


def stiffness(problem: fem.Problem, displacement: Tensor) -> np.ndarray:
    """Return the tangent at (1, N, D) on the free degrees of freedom, (n, n)."""
    values = problem.linearise(displacement).tangent[0].numpy()
    return full_matrix(problem.pattern, values).toarray()


def check_same(problem: fem.Problem, load: fem.Load, found: Tensor, expected: Tensor) -> None:
    """Check that two answers (1, N, D) are one, to within what their residuals allow.

    To first order K (u - v) = R(u) - R(v), so ||u - v|| is at most the residuals' sum over the
    lowest eigenvalue of K; ten times that for what is beyond first order.
    """
    residuals = [problem.residual(u, load.force).norm() for u in (found, expected)]
    lowest = np.linalg.eigvalsh(stiffness(problem, expected))[0]
    allowed = 10 * (sum(residuals) + slack(problem, expected)) / lowest
    assert (found - expected).norm() <= allowed


# ---------------------------------------------------------------- energy, force, tangent


@given(bodies(FREE, laws(finite=True)), steepnesses, seeds, seeds, st.floats(-3, 3))
def test_turned_and_moved_body_stores_as_much_and_feels_turned_forces(
    body, steepness, seed, turn, shift
):
    problem = body.build()
    u, Q = bent(problem, steepness, seed), rotation(body.dim, turn)
    moved = (problem.points + u) @ Q.mT + shift - problem.points
    force, turned = (problem.evaluate(v).internal for v in (u, moved))
    noise = slack(problem, moved, problem.points[None])  # points are added and taken away
    assert (turned - force @ Q.mT).norm() <= noise
    rest, here, there = (problem.energy(v) for v in (0 * u, u, moved))
    # of the error of strain the energy takes the square, and the product with the strain that is
    square = noise * EPS * (problem.points.abs().max() + moved.abs().max())
    allowed = ((here - rest).abs() * square).sqrt() + square
    # and its terms, of the order of the moduli where H is, cancel
    moduli = body.law.lam + 2 * body.law.mu
    volume = problem.dV.expand(len(problem.cells), -1).sum()
    allowed = allowed + 100 * EPS * (moduli * volume + rest.abs())
    assert (there - here).abs() <= allowed + 1e-12 * (here - rest).abs()


class Uncompiled(fem.Problem):
    """A problem without compiled loops."""

    _compiled = None


@given(body=bodies((*HELD, "free")), steepness=steepnesses, seed=seeds, length=st.floats(0.1, 1))
def test_compiled_loops_say_what_tensors_say(body, steepness, seed, length):
    """Forces, volume ratios and tangents, with mixed points and without."""
    problem = body.build()
    u = bent(problem, steepness, seed)
    found = problem.evaluate(u)
    assert (found.internal - problem.internal_force(u)).norm() <= slack(problem, u)
    change = gradients(problem, u).norm(dim=(-2, -1)).max()
    assert (found.volume_ratio - problem.volume_ratio(u)).abs() <= 10 * EPS * (1 + change)
    steps = [(problem.linearise(u), (problem.internal_force(u), problem.tangent(u)))]
    if problem.material.has_response and problem.volume_functions is None:
        update = 0.3 * bent(problem, steepness, seed ^ 1)
        gap = problem.update_strain_gap(None, length, update)
        plain = Uncompiled(**problem.__getstate__())
        exact = plain.update_strain_gap(None, length, update)
        steps.append((problem.linearise(u, gap), plain.linearise(u, exact)[:2]))
    unit = slack(problem, torch.ones_like(u))  # of forces where all displacements are 1
    for system, (force, tangent) in steps:
        assert system.valid.all()
        assert (system.force - force).norm() <= slack(problem, u)
        assert (system.tangent - tangent).norm() <= unit


# ---------------------------------------------------------------- the linear solution


@given(case=cases(supports=UNMOVED), other=seeds, data=st.data())
def test_linear_answers_are_reciprocal(case, other, data):
    """Maxwell, Betti: the work of a load on the answer to another is that of the other on its."""
    body, push = case
    linear = fem.LinearSolver(body.build())
    f, g = push.on(body, linear).force[0], data.draw(pushes(body)).on(body, linear).force[0]
    u, v = linear.solve(f), linear.solve(g)
    rest = torch.zeros(1, *linear.problem.shape, dtype=torch.float64)
    norm = np.linalg.norm(stiffness(linear.problem, rest), 2)
    assert ((f * v).sum() - (g * u).sum()).abs() <= 100 * EPS * norm * u.norm() * v.norm()


@given(case=cases(supports=UNMOVED, low=1e-12, high=1e-5))
def test_small_loads_have_an_answer_that_follows_the_linear_one(case):
    body, push = case
    newton = fem.Newton(body.build())
    problem, load = newton.problem, push.on(body, newton.linear_solver)
    answer = fem.solve(newton, load)
    assert answer.status.item() == fem.Status.CONVERGED
    u, linear = answer.displacement, newton.linear_solver.solve(load.force[0])
    steep = gradients(problem, u).norm(dim=(-2, -1)).max()
    second = 100 * steep * problem.roundoff_bound(u) / EPS  # of force in |H|
    rest = torch.zeros_like(u)
    gap = problem.tangent_product(rest, u - linear)
    gap = torch.where(problem.free, gap, 0.0).norm()
    assert gap <= answer.residual * load.force.norm() + second + slack(problem, u)


# ---------------------------------------------------------------- Newton


def check_states(newton: fem.Newton, load: fem.Load, states: list[fem.Solution]) -> None:
    """Check what Newton promises of the states that it yields for one load."""
    problem, last = newton.problem, states[-1]
    counts = [state.iterations.item() for state in states]
    assert counts == sorted(counts)
    assert counts[-1] <= newton.max_total_iter
    for state in states:
        again = fem.evaluate_solution(problem, state.displacement, load, newton.tol)
        assert torch.equal(again.residual, state.residual)
        assert torch.equal(again.volume_ratio, state.volume_ratio)
        assert state.displacement.isfinite().all()
        assert state.volume_ratio > 0
        assert 0 <= state.load_factor <= 1
        assert state.converged.item() == (state is last and again.converged.item())
        held = torch.where(problem.free, 0.0, state.displacement)[0]
        wanted = problem.prescribed
        part = (held * wanted).sum() / wanted.square().sum() if problem.moved_supports else 0.0
        assert -1e-12 <= part <= 1 + 1e-12
        assert (held - part * wanted).abs().max() <= 1e-12
    if last.converged:
        assert last.load_factor == 1
        apart = torch.where(problem.free, 0.0, last.displacement) - problem.prescribed
        assert apart.abs().max() <= newton.max_total_iter * EPS * problem.prescribed.abs().max()
        return
    factor, u = last.load_factor, last.displacement
    if last.status == fem.Status.NOT_CONVERGED:
        assert counts[-1] == newton.max_total_iter
    else:
        assert last.status == fem.Status.NO_VALID_EQUILIBRIUM
    assert (torch.where(problem.free, 0.0, u) - factor * problem.prescribed).abs().max() <= 1e-12
    if factor:
        internal, part = problem.evaluate(u).internal, factor * load.force
        assert problem.is_equilibrium(u, internal, part, newton.intermediate_tol).item()
    else:
        assert not u.any()


@given(case=cases(), mixed=st.booleans(), budget=st.sampled_from([1, 5, 60]))
def test_states_of_newton_are_not_inverted_and_say_what_they_are(case, mixed, budget):
    body, push = case
    newton = fem.Newton(body.build(), mixed_integration=mixed, max_total_iter=budget)
    load = push.on(body, newton.linear_solver)
    check_states(newton, load, list(newton.iterate(load)))


@given(case=cases(), steepness=logarithmic(1e-3, 3.0), seed=seeds)
def test_newton_says_the_same_of_states_from_any_guess(case, steepness, seed):
    body, push = case
    newton = fem.Newton(body.build(), max_total_iter=40)
    problem, load = newton.problem, push.on(body, newton.linear_solver)
    guess = bent(problem, steepness, seed)
    states = list(newton.iterate(load, guess=guess))
    check_states(newton, load, states)
    held = torch.where(problem.free, guess, problem.prescribed)
    usable = bool(problem.evaluate(held).volume_ratio > 0)
    assert states[0].from_guess.item() == usable
    if not usable:
        assert torch.equal(states[-1].displacement, fem.solve(newton, load).displacement)


@given(case=cases(low=1e-2, high=3.0))
def test_answer_that_counts_as_stable_is_a_minimum(case):
    """The inertia of its tangent is what the solution says, and near it the energy is higher.

    An answer so close to a critical load that an eigenvalue is a hundredth of what it was at rest
    may be either.
    """
    body, push = case
    newton = fem.Newton(body.build(), max_total_iter=60)
    problem, load = newton.problem, push.on(body, newton.linear_solver)
    answer = fem.solve(newton, load)
    assume(answer.converged.all())
    u, count = answer.displacement, answer.negative_pivots.item()
    rest = np.linalg.eigvalsh(stiffness(problem, torch.zeros_like(u)))
    values, vectors = np.linalg.eigh(stiffness(problem, u))
    assume(np.abs(values).min() > 1e-2 * rest[0])
    negative = int((values < 0).sum())
    assert answer.stable.item() == (negative == 0)
    assert count == negative

    def total(v: Tensor) -> Tensor:
        return problem.energy(v) - (load.force * v).sum()

    softest = torch.zeros_like(u)
    softest[0, problem.free] = torch.from_numpy(vectors[:, 0])
    h = 1e-3 / gradients(problem, softest).norm(dim=(-2, -1)).max()
    sides = torch.stack([total(u + h * softest), total(u - h * softest)]) - total(u)
    curved = h**2 / 2 * values[0]
    assume(abs(curved) > 1e-9 * total(u).abs() + 1e-9 * problem.energy(u).abs())  # else rounding
    assert sides.mean().sign() == np.sign(values[0])


@given(case=cases(low=1e-3, high=0.3), factor=logarithmic(1e-6, 1e6), young=logarithmic(1, 1e12))
def test_answer_depends_neither_on_the_size_of_the_body_nor_on_its_modulus(case, factor, young):
    body, push = case
    newton = fem.Newton(body.build(), max_total_iter=60)
    load = push.on(body, newton.linear_solver)
    larger = fem.Newton(replace(body, size=factor * body.size).build(), max_total_iter=60)
    answer = fem.solve(newton, load)
    stiffer = fem.Load(load.force, torch.tensor([young], dtype=torch.float64))
    assert torch.equal(fem.solve(newton, stiffer).displacement, answer.displacement)
    assume(answer.stable.all())
    again = fem.solve(larger, load)
    assert again.stable.all()
    check_same(newton.problem, load, again.displacement, answer.displacement)


@given(case=cases(supports=UNMOVED, low=1e-3, high=0.3), turn=seeds, shift=st.floats(0, 5))
def test_answer_turns_with_body_supports_and_load(case, turn, shift):
    """In metres: the turned body may be measured by another side of another box around it."""
    body, push = case
    assume(body.support != "rollers")
    turned = replace(body, turned=turn, shift=shift)
    first, second = (fem.Newton(one.build(), max_total_iter=60) for one in (body, turned))
    load = push.on(body, first.linear_solver)
    answer = fem.solve(first, load)
    assume(answer.stable.all())
    unit = first.problem.length / second.problem.length
    Q = torch.from_numpy(turned.rotation @ body.rotation.T)
    there = load_of(load.force @ Q.mT * unit ** (body.dim - 1))
    again = fem.solve(second, there)
    assert again.stable.all()
    back = again.displacement @ Q / unit
    check_same(first.problem, load, back, answer.displacement)


@at_most(0.5)
@given(case=cases(low=1e-3, high=0.2), data=st.data())
def test_ways_to_solve_change_the_way_and_not_the_answer(case, data):
    body, push = case
    newton = fem.Newton(body.build(), max_total_iter=60)
    problem, load = newton.problem, push.on(body, newton.linear_solver)
    answer = fem.solve(newton, load)
    assume(answer.stable.all())
    for change in (
        {"linear": data.draw(st.sampled_from(fem.installed_backends()))},
        {"mixed_integration": False},
        {"factor_reuse_tol": data.draw(st.sampled_from([0.0, 1.0]))},
        {"corotational": True},
        {"min_detF_ratio": 0.9},
    ):
        again = fem.solve(fem.Newton(problem, **({"max_total_iter": 200} | change)), load)
        assert again.stable.all()
        check_same(problem, load, again.displacement, answer.displacement)


@given(case=cases(low=1e-3, high=1.0))
def test_images_of_an_answer_answer_the_images_of_its_load(case):
    body, push = case
    body = replace(body, grading=(1.0,) * body.dim, shaken=0.0)
    newton = fem.Newton(body.build(), max_total_iter=60)
    problem, load = newton.problem, push.on(body, newton.linear_solver)
    answer = fem.solve(newton, load)
    group = fem.symmetries(problem)
    mirrored = body.support not in ("moved", "rollers") and body.cell in ("quad", "hexahedron")
    assert len(group) > mirrored
    for symmetry in group:
        image, force = symmetry.image(answer.displacement), symmetry.image(load.force)
        residual = symmetry.image(problem.residual(answer.displacement, load.force))
        found = problem.residual(image, force)
        # where a cell is nearly flat, rounding of det F counts by its inverse
        allowed = 10 * slack(problem, image) / answer.volume_ratio.clamp(max=1.0)
        assert (found - residual).norm() <= allowed + 1e-10 * found.norm()

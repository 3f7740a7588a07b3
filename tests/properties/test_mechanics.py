"""What holds for any body, law, support and load: laws of mechanics, and what solvers promise."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from bodies import (
    HELD,
    HOOKEAN,
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
from hypothesis import assume, given
from hypothesis import strategies as st
from torch import Tensor
from tried import at_most, counted

from dpl import fem
from dpl.fem.linear import full_matrix
from dpl.fem.solvers import concatenate

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


def turning(points: Tensor, force: Tensor) -> Tensor:
    """Return the sum of x f^T - f x^T, (D, D), and so all moments, of points and forces (N, D)."""
    moments = points.mT @ force
    return moments - moments.mT


# ---------------------------------------------------------------- energy, force, tangent


@given(
    body=bodies(FREE, laws(finite=True)),
    steepness=steepnesses,
    seed=seeds,
    turn=seeds,
    shift=st.floats(-3, 3),
)
@counted
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


@given(body=bodies(FREE), steepness=steepnesses, seed=seeds)
@counted
def test_forces_inside_a_body_have_neither_sum_nor_moment(body, steepness, seed):
    """The moment of the law of small strains is that about the points at rest."""
    problem = body.build()
    u = bent(problem, steepness, seed)
    force = problem.evaluate(u).internal[0]
    allowed = slack(problem, u) * math.sqrt(len(force))
    assert force.sum(dim=0).norm() <= allowed
    points = problem.points - problem.points.mean(dim=0)
    points = points if isinstance(body.law, fem.LinearElastic) else points + u[0]
    assert turning(points, force).norm() <= allowed * points.norm(dim=1).max()


@given(body=bodies((*HELD, "free")), steepness=logarithmic(1e-4, 0.6), seed=seeds)
@counted
def test_force_is_the_slope_of_the_energy(body, steepness, seed):
    problem = body.build()
    u = bent(problem, steepness, seed).requires_grad_()
    (slope,) = torch.autograd.grad(problem.energy(u).sum(), u)
    u = u.detach()
    # an energy is differentiated term by term, and these cancel at rest: magnitudes of H = 1
    allowed = slack(problem, u / steepness)
    assert (torch.where(problem.free, slope - problem.internal_force(u), 0.0)).norm() <= allowed


@given(body=bodies(), steepness=logarithmic(1e-3, 0.5), seed=seeds, along=seeds)
@counted
def test_tangent_is_symmetric_and_the_slope_of_the_force(body, steepness, seed, along):
    problem = body.build()
    u = bent(problem, steepness, seed)
    v, w = (torch.where(problem.free, bent(problem, 1.0, along ^ k), 0.0) for k in (0, 1))
    K, scale = stiffness(problem, u), slack(problem, v) / EPS
    Kv, Kw = (problem.tangent_product(u, x) for x in (v, w))
    assert ((Kv * w).sum() - (Kw * v).sum()).abs() <= EPS * scale * w.norm()
    assert np.linalg.norm(K @ problem.restrict(v[0]) - problem.restrict(Kv[0])) <= EPS * scale
    h = 1e-4
    ahead, behind = (problem.evaluate(u + s * h * v).internal for s in (1, -1))
    slope = (ahead - behind) / (2 * h)
    assert torch.where(problem.free, slope - Kv, 0.0).norm() <= 1e-8 * scale


class Uncompiled(fem.Problem):
    """A problem without compiled loops."""

    _compiled = None


@given(body=bodies((*HELD, "free")), steepness=steepnesses, seed=seeds, length=st.floats(0.1, 1))
@counted
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


@given(body=bodies((*HELD, "free")), steepness=steepnesses, seed=seeds)
@counted
def test_batch_is_evaluated_like_its_members(body, steepness, seed):
    problem = body.build()
    u = bent(problem, steepness, seed, batch=3)
    unit = slack(problem, torch.ones_like(u[:1]))
    for k, one in enumerate(u.split(1)):
        for name in ("internal_force", "volume_ratio", "energy", "tangent"):
            whole, alone = getattr(problem, name)(u)[k], getattr(problem, name)(one)[0]
            assert (whole - alone).norm() <= unit * max(1, alone.abs().max())
        whole, alone = problem.evaluate(u), problem.evaluate(one)
        assert torch.equal(whole.volume_ratio[k], alone.volume_ratio[0])
        assert (whole.internal[k] - alone.internal[0]).norm() <= slack(problem, one)


# ---------------------------------------------------------------- supports and loads


@given(body=bodies(FREE), seed=seeds, held=st.integers(0, 7), mask=seeds)
@counted
def test_motions_that_are_named_loose_are_those_that_cost_nothing(body, seed, held, mask):
    random, problem = np.random.default_rng(mask), body.build()
    fixed = np.zeros(problem.shape, dtype=bool)
    fixed.flat[random.choice(fixed.size, held, replace=False)] = True
    if held:
        problem = body.build(fixed=fixed)
    values = np.linalg.eigvalsh(
        stiffness(problem, torch.zeros(1, *problem.shape, dtype=torch.float64))
    )
    abort_if_slow = (values > 1e-12 * values[-1]) & (values < 1e-8 * values[-1])
    assume(not abort_if_slow.any())  # nodes that are hardly out of line
    assert len(problem.unconstrained_rigid_body_modes()) == (values < 1e-10 * values[-1]).sum()


# ---------------------------------------------------------------- the linear solution


@given(case=cases(supports=UNMOVED), other=seeds, data=st.data())
@counted
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
@counted
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


@given(body=bodies(UNMOVED), count=st.integers(1, 5))
@counted
def test_modes_are_the_lowest_eigenvectors(body, count):
    linear = fem.LinearSolver(body.build())
    problem = linear.problem
    assume(count <= problem.pattern.size // 3)
    values, vectors = fem.eigenmodes(linear, count)
    assert len(values) >= count
    K = stiffness(problem, torch.zeros(1, *problem.shape, dtype=torch.float64))
    exact = np.linalg.eigvalsh(K)
    assert np.abs(values.numpy() - exact[: len(values)]).max() <= 1e-10 * exact[-1]
    assert not vectors[~problem.free].any()
    V = vectors[problem.free].numpy()
    assert np.abs(V.T @ V - np.eye(V.shape[1])).max() <= 1e-9
    assert np.linalg.norm(K @ V - V * values.numpy(), axis=0).max() <= 1e-9 * exact[-1]


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
        internal = problem.evaluate(u).internal
        assert problem.is_equilibrium(
            u, internal, factor * load.force, newton.intermediate_tol
        ).item()
    else:
        assert not u.any()


@given(case=cases(), mixed=st.booleans(), budget=st.sampled_from([1, 5, 60]))
@counted
def test_states_of_newton_are_not_inverted_and_say_what_they_are(case, mixed, budget):
    body, push = case
    newton = fem.Newton(body.build(), mixed_integration=mixed, max_total_iter=budget)
    load = push.on(body, newton.linear_solver)
    check_states(newton, load, list(newton.iterate(load)))


@given(case=cases(), steepness=logarithmic(1e-3, 3.0), seed=seeds)
@counted
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


@given(case=cases(low=1e-3, high=3.0))
@counted
def test_answer_is_in_balance_as_a_whole(case):
    """Reactions, springs and loads have neither sum nor moment in the deformed body."""
    body, push = case
    newton = fem.Newton(body.build(), max_total_iter=60)
    problem, load = newton.problem, push.on(body, newton.linear_solver)
    answer = fem.solve(newton, load)
    assume(answer.converged.all())
    u, f = answer.displacement, load.force
    internal = problem.evaluate(u).internal
    reactions = torch.where(problem.free, 0.0, internal - f)
    springs = 0.0 if problem.springs is None else problem.springs.force(u)
    total = (reactions + f - springs)[0]
    left = problem.residual(u, f).norm()
    # rounding on held nodes is not in `Problem.roundoff_bound`
    allowed = math.sqrt(len(total)) * (
        left + 100 * EPS * total.norm() + slack(body.build(fixed=None), u)
    )
    assert total.sum(dim=0).norm() <= allowed
    points = problem.points - problem.points.mean(dim=0)
    points = points if isinstance(body.law, fem.LinearElastic) else points + u[0]
    assert turning(points, total).norm() <= 2 * allowed * points.norm(dim=1).max()


@given(case=cases(low=1e-2, high=3.0))
@counted
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
@counted
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
@counted
def test_answer_turns_with_body_supports_and_load(case, turn, shift):
    """In metres: the turned body may be measured by another side of another box around it."""
    body, push = case
    assume(body.support != "rollers")
    turned = replace(body, turned=turn, shift=shift)
    first, second = (
        fem.Newton(body.build(), max_total_iter=60),
        fem.Newton(turned.build(), max_total_iter=60),
    )
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
@counted
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


@at_most(0.5)
@given(body=bodies(), data=st.data())
@counted
def test_batch_is_solved_like_its_members(body, data):
    """To the last bit, with factors of one's own; MKL holds one at a time."""
    backend = data.draw(
        st.sampled_from([name for name in fem.installed_backends() if name != "pardiso"])
    )
    newton = fem.Newton(body.build(), max_total_iter=30, linear=backend)
    drawn = data.draw(st.lists(pushes(body, 1e-3), min_size=2, max_size=4))
    loads = [push.on(body, newton.linear_solver) for push in drawn]
    batch = fem.solve(newton, load_of(torch.cat([load.force for load in loads])))
    alone = concatenate([fem.solve(newton, load) for load in loads])
    for name in ("displacement", "status", "residual", "iterations", "load_factor"):
        assert torch.equal(getattr(batch, name), getattr(alone, name))


@at_most(0.5)
@given(
    body=bodies(),
    kind=st.sampled_from(HOOKEAN),
    ratios=st.lists(st.floats(-0.4, 0.45), min_size=2, max_size=3),
    data=st.data(),
)
@counted
def test_loads_with_their_own_parameters_are_solved_like_bodies_of_one(body, kind, ratios, data):
    some = fem.Newton(
        replace(body, law=kind([-0.5, 0.46])).build(), max_total_iter=40, linear="superlu"
    )
    forces = [
        data.draw(pushes(body, 1e-3, 0.5)).on(body, some.linear_solver.reference).force
        for _ in ratios
    ]
    poisson = torch.tensor(ratios, dtype=torch.float64)
    load = fem.Load(torch.cat(forces), torch.ones(len(ratios), dtype=torch.float64), poisson)
    batch = fem.solve(some, load)
    for k, nu in enumerate(ratios):
        problem = replace(body, law=kind(nu)).build()
        alone = fem.solve(
            fem.Newton(problem, max_total_iter=40, linear="superlu"), load_of(forces[k])
        )
        for name in ("status", "displacement", "residual"):
            assert torch.equal(getattr(batch, name)[k], getattr(alone, name)[0])


@given(body=bodies(FREE, inner=True), steepness=logarithmic(1e-6, 0.1), seed=seeds)
@counted
def test_homogeneous_deformation_of_the_surface_is_one_of_the_whole(body, steepness, seed):
    """The patch test on shaken grids, all elements and laws."""
    H = torch.from_numpy(np.random.default_rng(seed).standard_normal((body.dim, body.dim)))
    plain = body.build()
    exact = plain.points @ (steepness * H / H.norm()).mT
    held = plain.boundary.numpy()
    problem = body.build(fixed=held, prescribed=exact.numpy())
    load = load_of(torch.zeros(1, *problem.shape, dtype=torch.float64))
    answer = fem.solve(fem.Newton(problem), load)
    assert answer.status.item() == fem.Status.CONVERGED
    check_same(problem, load, answer.displacement, exact[None])


@given(case=cases(low=1e-3, high=1.0))
@counted
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

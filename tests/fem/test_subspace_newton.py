"""Newton's method in a subspace: exact limit, convergence, and no damage by any guess."""

import pickle
from dataclasses import replace
from itertools import cycle, pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from laws import LAWS
from solving import KINDS, noise
from torch import Tensor
from torch.testing import assert_close

from dpl import fem
from dpl.fem.assembly.follower_loads import NO_LOADS
from dpl.fem.rom.ecsw import Cubature
from dpl.fem.rom.pod import orthonormal_fields, pod
from dpl.fem.rom.sampled_tangent import SampledTangent

NH = fem.NeoHookeanLn(0.3)
LEFT = fem.Plane(0, "min")


def some_modes(problem: fem.Problem, rank: int) -> Tensor:
    """Return a random orthonormal basis of smooth displacements, (N, D, R)."""
    linear = fem.Newton(problem, linear="superlu").linear_solver
    forces = problem.free * noise(rank, *problem.shape)
    fields = torch.stack([linear.solve(force) for force in forces])
    return orthonormal_fields(fields[:, problem.free].T, problem.free)


def best_modes(problem: fem.Problem, fields: Tensor, rank: int) -> Tensor:
    """Return the modes of displacements (S, N, D), (N, D, R)."""
    return orthonormal_fields(pod(fields[:, problem.free], rank).vectors, problem.free)


def every_cell(problem: fem.Problem) -> Cubature:
    """Return all cells with weight one."""
    count = len(problem.cells)
    return Cubature(torch.arange(count), torch.ones(count, dtype=torch.float64), 0.0)


def errors(answer: Tensor, truth: Tensor) -> Tensor:
    """Return the relative error of each displacement, (B,)."""
    return (answer - truth).flatten(1).norm(dim=1) / truth.flatten(1).norm(dim=1)


@pytest.fixture
def evaluated(monkeypatch) -> list[Tensor]:
    """The displacements at which a body has been evaluated."""
    calls, evaluate = [], fem.Problem.evaluate
    monkeypatch.setattr(
        fem.Problem, "evaluate", lambda self, u: calls.append(u) or evaluate(self, u)
    )
    return calls


@pytest.fixture(scope="module")
def unseen(newton) -> fem.Load:
    """Six other loads."""
    return fem.ModalLoads(newton.linear_solver, n_modes=3).sample(1, range(6))


@pytest.fixture(scope="module")
def truth(newton, unseen) -> Tensor:
    """Their solutions."""
    return fem.solve(newton, unseen).displacement


@pytest.fixture(scope="module")
def vectors(newton, snapshots) -> Tensor:
    """Twelve modes of the solutions."""
    return best_modes(newton.problem, snapshots[:40], 12)


@pytest.fixture(scope="module")
def solver(newton, vectors, snapshots) -> fem.SubspaceNewton:
    """The solver with few cells."""
    return fem.SubspaceNewton.within(
        newton.problem, vectors, snapshots[:40], error_tol=1e-9, max_iter=10
    )


def solve_from(solver: fem.SubspaceNewton, load: fem.Load, guess: Tensor) -> Tensor:
    """Return the last displacements from a guess."""
    *_, last = solver.iterate(load, guess=guess)
    return last.displacement


def astray(vectors: Tensor, truth: Tensor, size: float, seed: int = 0) -> Tensor:
    """Return solutions with errors of a relative size in the subspace."""
    way = (vectors @ noise(vectors.shape[2], len(truth), seed=seed)).movedim(2, 0)
    lengths = truth.flatten(1).norm(dim=1) / way.flatten(1).norm(dim=1)
    return truth + size * lengths[:, None, None] * way


# ------------------------------------------------------------------ tangent


SAMPLED = [  # one law of each kind of compiled loop, and one that has none
    *("linear_elastic", "saint_venant_kirchhoff", "stable_neo_hookean", "neo_hookean_ln"),
    *("mooney_rivlin_k2", "guccione", "ogden_k2"),
]


@pytest.mark.parametrize(
    ("name", "cell"), list(zip(SAMPLED, cycle(["triangle", "tetra"]))), ids=str
)
def test_all_cells_of_one_point_give_the_tangent_of_the_body(name, cell, grid, bend):
    problem = fem.Problem.build(grid(cell, 2, 0.3, inside=True), LAWS[name], fixed=LEFT)
    vectors, u = some_modes(problem, 4), 0.5 * bend(problem.points)[0]
    found = SampledTangent(problem, vectors, every_cell(problem)).at(problem, u)
    exact = SampledTangent(problem, vectors, None).at(problem, u)
    assert_close(found, exact, rtol=0, atol=2e-6 * abs(exact).max())


def test_follower_loads_add_the_derivative_of_their_forces(grid, bend):
    """The symmetric part; loads have nodes in common, and fixed nodes have no rows."""
    loads = [fem.FollowerPressure(fem.Plane(axis, "max"), 0.1 + axis) for axis in (0, 2)]
    lower, oblique = fem.Box([0.0, 0.0, 0.0], [1.0, 1.0, 0.5]), fem.ConstantFibres([1.0, 0.6, 0.3])
    loads.append(fem.ActiveStress(0.2, region=lower, directions=oblique))
    mesh = grid("tetra", 2, 0.3, inside=True)
    problem = fem.Problem.build(mesh, NH, fixed=LEFT, follower_loads=loads)
    vectors, u = some_modes(problem, 4), 0.5 * bend(problem.points)[0]
    dead = replace(problem, follower_loads=NO_LOADS)
    models = [SampledTangent(body, vectors, every_cell(body)) for body in (problem, dead)]
    found, elastic = (model.at(model.problem, u) for model in models)
    white = (vectors @ torch.from_numpy(models[0].scale)).movedim(2, 0)
    ends = (problem.follower_loads.force(u + sign * 1e-6 * white) for sign in (1, -1))
    slope = white.flatten(1) @ ((next(ends) - next(ends)) / 2e-6).flatten(1).T
    assert_close(torch.from_numpy(found - elastic), (slope + slope.T) / 2, rtol=0, atol=1e-7)


@pytest.mark.parametrize(("name", "kind"), zip(cycle(SAMPLED), KINDS), ids=str)
def test_compiled_and_tensor_moduli_agree(name, kind, grid, bend):
    """At the mean gradients of the cells of all elements."""
    cell, degree = kind
    mesh = grid(cell, 1 if degree == 2 else 2, 0.3, inside=True)
    problem = fem.Problem.build(mesh, LAWS[name], fixed=LEFT, degree=degree)
    model = SampledTangent(problem, some_modes(problem, 3), every_cell(problem))
    u = bend(problem.points)[0]
    found = model._moduli_change_product(problem, u)
    expected = model._reference_product(problem.material, u)
    assert_close(found, expected, rtol=0, atol=1e-6 * max(abs(expected).max(), 1e-3))


@pytest.mark.parametrize("mean_dilatation", [False, True])
def test_stiffness_at_rest_with_ranges(mean_dilatation):
    """Poisson's ratio of the load decides, of quadrature, dilatation and springs."""
    springs = [fem.RobinBC(fem.Plane(0, "max"), 0.3)]
    problem = fem.Problem.build(
        fem.box([1.0, 1.0, 1.0], [3, 3, 3]), fem.NeoHookeanLn((0.1, 0.45)),
        fixed=LEFT, supports=springs, mean_dilatation=mean_dilatation,
    )  # fmt: skip
    vectors = some_modes(problem.reference, 5)
    model = SampledTangent(problem, vectors, every_cell(problem))
    zero = torch.zeros(problem.shape, dtype=torch.float64)
    for poisson in (0.1, 0.2, 0.45):
        body = problem.with_parameters(torch.tensor([[poisson]]))
        found = torch.from_numpy(model.at(body, zero))
        expected = by_products(body, vectors @ torch.from_numpy(model.scale))
        assert_close(found, expected, rtol=0, atol=1e-10)


def by_products(body: fem.Problem, white: Tensor) -> Tensor:
    """Return W^T K(0) W by products with the tangent."""
    zero, fields = torch.zeros(1, *body.shape, dtype=torch.float64), white.movedim(2, 0)
    columns = [body.tangent_product(zero, field[None])[0] for field in fields]
    return torch.stack(columns).flatten(1) @ fields.flatten(1).T


# ------------------------------------------------------------------ steps


def test_limit_is_the_equilibrium_in_the_subspace(newton, solver, vectors, unseen):
    start = fem.SubspaceNewton(newton.problem, vectors, max_iter=8)
    projected = solve_from(start, unseen, torch.zeros_like(unseen.force))
    modes = vectors.movedim(2, 0)
    for u, force in zip(projected, unseen.force, strict=True):  # Newton in float64
        for _ in range(2):
            products = [newton.problem.tangent_product(u[None], mode[None])[0] for mode in modes]
            tangent = torch.stack(products).flatten(1) @ modes.flatten(1).T
            right = modes.flatten(1) @ newton.problem.residual(u[None], force[None]).flatten()
            u -= vectors @ torch.linalg.solve(tangent, right)
        assert right.norm() < 1e-7 * (modes.flatten(1) @ force.flatten()).norm()
    guess = astray(vectors, projected, 0.05)
    assert errors(guess, projected).min() > 1e-2
    whole = replace(solver, cubature=None)
    for one in (solver, whole):
        assert errors(solve_from(one, unseen, guess), projected).max() < 3e-6


def test_exact_tangent_converges_quadratically(newton, vectors, unseen):
    exact = fem.SubspaceNewton(newton.problem, vectors, error_tol=1e-12, max_iter=8)
    limit = solve_from(exact, unseen, torch.zeros_like(unseen.force))
    for force, u in zip(unseen.force.split(1), limit.split(1), strict=True):
        states = exact.states(fem.Load(force, torch.ones(1)), guess=astray(vectors, u, 1e-3))
        found = [errors(state.displacement, u).item() for state in states][:3]
        for before, after in pairwise(found):
            assert after < max(300 * before**2, 1e-6)


def test_few_cells_leave_a_small_part_of_the_error(solver, vectors, unseen, truth):
    assert len(solver.cubature.cells) < len(solver.problem.cells)
    guess = astray(vectors, truth, 0.02)
    steps = [s.displacement for s in solver.iterate(unseen, guess=guess)]
    reach = errors(steps[-1], truth)
    assert float(errors(steps[1], truth).median()) < 5e-3
    assert reach.max() < 1e-4


def test_estimates_are_those_of_the_error_in_the_subspace(solver, unseen, truth, vectors):
    limit = solve_from(solver, unseen, truth)
    guess = astray(vectors, limit, 1e-3)
    for k, force in enumerate(unseen.force.split(1)):
        load = fem.Load(force, torch.ones(1))
        states = list(solver.states(load, guess=guess[k, None]))
        assert states[0].error == pytest.approx(1e-3, rel=0.2)
        assert errors(states[1].displacement, limit[k, None]) < 3e-4
        assert states[-1].error < 3e-6


def test_gains_move_the_limit_by_a_part_of_the_first_correction(solver, vectors, unseen):
    """At most by 1e-4 of the displacement."""
    limit = solve_from(solver, unseen, torch.zeros_like(unseen.force))
    gained = replace(solver, cubature=None, gains=0.2 * torch.eye(12).double())
    near, far = (astray(vectors, limit, size) for size in (1e-4, 0.05))
    moved = solve_from(gained, unseen, near) - limit
    expected = 0.2 * (limit - near)
    assert ((moved - expected).flatten(1).norm(dim=1) < 0.1 * expected.flatten(1).norm(dim=1)).all()
    sizes = errors(solve_from(gained, unseen, far), limit)
    assert sizes.tolist() == pytest.approx([1e-4] * 6, rel=0.2)


def test_steps_end_at_the_estimated_error(newton, solver, vectors, unseen, truth):
    loose = fem.SubspaceNewton(newton.problem, vectors, solver.cubature, error_tol=1e-2)
    limit = solve_from(solver, unseen, truth)
    near, far = (list(loose.iterate(unseen, guess=astray(vectors, limit, e))) for e in (1e-3, 0.1))
    assert len(near) == 1
    assert len(far) > 1
    assert solve_from(loose, unseen, astray(vectors, limit, 1e-3)).equal(near[0].displacement)


def test_no_evaluation_begins_when_the_time_is_over(newton, vectors, unseen, truth, evaluated):
    whole = fem.SubspaceNewton(newton.problem, vectors, error_tol=1e-6)
    load, guess = unseen.unbatch()[0], astray(vectors, truth, 0.1)[:1]
    expected = list(whole.states(load, guess=guess))
    assert len(expected) > 2
    evaluated.clear()
    for most in range(1, len(expected)):
        evaluated.clear()
        found = list(whole.states(load, guess=guess, is_over=lambda n=most: len(evaluated) >= n))
        assert len(evaluated) == most
        for a, b in zip(expected, found, strict=False):
            assert torch.equal(a.displacement, b.displacement)
        assert found[-1].iterations <= most


def test_errors_outside_the_subspace_remain(solver, vectors, unseen, truth):
    free, basis = solver.problem.free, vectors[solver.problem.free]
    guess = truth + torch.where(free, 1e-4 * noise(*truth.shape), 0.0)
    change = (solve_from(solver, unseen, guess) - guess)[:, free]
    assert change.any()
    assert_close(change @ basis @ basis.T, change, rtol=0, atol=1e-6 * float(change.abs().max()))


def test_a_known_evaluation_is_not_repeated(solver, unseen, truth, vectors, evaluated):
    guess, load = astray(vectors, truth, 0.01)[:1], unseen.unbatch()[0]
    evaluation = solver.problem.evaluate(guess)
    expected = list(solver.states(load, guess=guess))
    evaluated.clear()
    found = list(solver.states(load, guess=guess, evaluation=evaluation))
    for a, b in zip(expected, found, strict=True):
        assert torch.equal(a.displacement, b.displacement)
        assert a.error == b.error
    assert not any(torch.equal(u, guess) for u in evaluated)


def test_solutions_are_evaluated_displacements(solver, unseen, truth, vectors):
    for one in solver.iterate(unseen, guess=astray(vectors, truth, 0.01)):
        again = fem.evaluate_solution(solver.problem, one.displacement, unseen, solver.tol)
        assert_close(one.residual, again.residual, rtol=1e-9, atol=0)
        assert_close(one.volume_ratio, again.volume_ratio, rtol=1e-12, atol=0)


# ------------------------------------------------------------------ any guess


@settings(max_examples=15, deadline=None)
@given(
    amplitude=st.floats(0.0, 30.0),
    size=st.sampled_from([0.0, 1e-3, 0.1, 1.0, 10.0]),
    rough=st.sampled_from([0.0, 1e-3, 1e-1]),
    seed=st.integers(0, 100),
)
def test_no_guess_becomes_worse(solver, vectors, unseen, truth, amplitude, size, rough, seed):
    problem, k = solver.problem, seed % len(truth)
    load = fem.Load(amplitude * unseen.force[k, None], torch.ones(1))
    guess = astray(vectors, truth[k, None], size, seed)
    guess = torch.where(problem.free, guess + rough * noise(*guess.shape, seed=seed), 0.0)
    states = list(solver.states(load, guess=guess))
    first, last = states[0], states[-1]
    assert last.error <= first.error
    assert last.displacement.isfinite().all()
    if first.evaluation.volume_ratio > 0:
        assert all(s.evaluation.volume_ratio > 0 for s in states)
    else:
        assert len(states) == 1
        assert last.error == torch.inf
        assert torch.equal(last.displacement, guess)


def test_extreme_forces_end_as_a_value(solver, unseen, truth):
    factors = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e300, 1e200, 1e-290]).double()
    force = factors[:, None, None] * unseen.force
    *_, last = solver.iterate(fem.Load(force, unseen.young), guess=truth)
    assert last.displacement.isfinite().all()
    assert not last.converged.any()


def test_accuracy_does_not_depend_on_the_size_of_the_load(solver, unseen):
    """Where the problem is linear."""
    zero, scales = torch.zeros_like(unseen.force), (1e-9, 1e-12, 1e-200)
    unit, *others = (
        solve_from(solver, fem.Load(scale * unseen.force, unseen.young), zero) / scale
        for scale in scales
    )
    for found in others:
        assert_close(found, unit, rtol=0, atol=1e-5 * float(found.abs().max()))


def test_zero_load_is_answered_by_zero(solver, newton):
    zero = torch.zeros(1, *newton.problem.shape, dtype=torch.float64)
    *_, last = solver.iterate(fem.Load(zero, torch.ones(1)))
    assert last.converged.all()
    assert not last.displacement.any()


# ------------------------------------------------------------------ bodies


@pytest.mark.parametrize("cubature", [False, True])
def test_loads_with_parameters_of_their_own(cubature, pull):
    mesh = fem.box([100.0, 25.0, 25.0], [5, 3, 3])
    problem = fem.Problem.build(mesh, fem.NeoHookeanLn((0.1, 0.4)), fixed=LEFT)
    newton = fem.Newton(problem, linear="superlu", tol=1e-10)
    force = torch.cat([pull(problem, q) for q in (10.0, 20.0, 30.0)])
    load = fem.Load(force, torch.ones(3), torch.tensor([0.12, 0.25, 0.38], dtype=torch.float64))
    truth = fem.solve(newton, load).displacement
    vectors = best_modes(problem, truth, 3)
    cells = every_cell(problem) if cubature else None
    solver = fem.SubspaceNewton(problem, vectors, cells, error_tol=1e-9, max_iter=20)
    assert errors(solve_from(solver, load, 0.9 * truth), truth).max() < 3e-6


@pytest.mark.parametrize("kind", [("quad", 1), ("triangle", 2)], ids=str)
def test_plane_body_with_moved_support_and_springs(kind, grid):
    cell, degree = kind
    ends = [
        fem.DirichletBC(LEFT),
        fem.DirichletBC(fem.Plane(0, "max"), [0.2, 0.0]),
        fem.RobinBC(fem.Plane(1, "min"), 0.1),
    ]
    problem = fem.Problem.build(grid(cell, 2), NH, supports=ends, degree=degree)
    force = problem.free * 0.02 * noise(4, *problem.shape)
    load = fem.Load(force, torch.ones(4))
    truth = fem.solve(fem.Newton(problem, linear="superlu", tol=1e-10), load).displacement
    vectors = best_modes(problem, truth, 4)
    solver = fem.SubspaceNewton(problem, vectors, every_cell(problem), error_tol=1e-9, max_iter=20)
    guess = torch.where(problem.free, 0.8 * truth, 7.0)  # supports are corrected
    assert errors(solve_from(solver, load, guess), truth).max() < 3e-6
    *_, rest = solver.iterate(load)
    assert errors(rest.displacement, truth).max() < 3e-6


# ------------------------------------------------------------------ options


def test_batch_is_solved_like_its_members(solver, unseen, truth, vectors):
    guess = astray(vectors, truth, 0.02)
    *_, batch = solver.iterate(unseen, guess=guess)
    for k, load in enumerate(unseen.unbatch()):
        *_, member = solver.iterate(load, guess=guess[k, None])
        for name in ("displacement", "residual", "volume_ratio", "iterations", "factorisations"):
            assert torch.equal(getattr(member, name)[0], getattr(batch, name)[k]), name


def test_pickled_solver_has_the_same_solutions(solver, unseen, truth, vectors):
    guess = astray(vectors, truth, 0.02)
    copy = pickle.loads(pickle.dumps(solver))
    assert torch.equal(solve_from(copy, unseen, guess), solve_from(solver, unseen, guess))


def test_invalid_options_are_refused_by_name(newton, beam, vectors):
    for name, value in (("tol", 0), ("error_tol", 0), ("error_tol", 1.5), ("max_iter", -1)):
        with pytest.raises(ValueError, match=f"^{name} = {value} must"):
            fem.SubspaceNewton(newton.problem, vectors, **{name: value})
    with pytest.raises(ValueError, match=r"vectors\.shape"):
        fem.SubspaceNewton(beam(NH, 4, 1), vectors)
    with pytest.raises(ValueError, match="fixed degrees of freedom"):
        fem.SubspaceNewton(newton.problem, vectors + 1.0)

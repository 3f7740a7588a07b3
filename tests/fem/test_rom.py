"""Laws of POD-Galerkin: the best subspace, equilibrium in it, hyper-reduction to few cells."""

import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from benchmarks.pod_galerkin import PODGalerkin
from dpl.fem import (
    DirichletBC,
    LinearElastic,
    LinearSolver,
    Load,
    ModalLoads,
    NeoHookeanLn,
    Newton,
    Plane,
    Problem,
    RobinBC,
    SaintVenantKirchhoff,
    Status,
    box,
    solve,
)
from dpl.fem.assembly.rigid_body_modes import rigid_body_modes
from dpl.fem.rom import Cubature
from dpl.fem.rom.ecsw import cubature, nonnegative
from dpl.fem.rom.pod import pod

NH = NeoHookeanLn(0.3)


def load_of(force: torch.Tensor) -> Load:
    """Return a load of the beam's stiffness."""
    return Load(force, torch.full((len(force),), 4500.0))


def errors(answer: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Return the relative error of each displacement, (B,)."""
    return (answer - truth).flatten(1).norm(dim=1) / truth.flatten(1).norm(dim=1)


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    """Return random numbers."""
    random = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=random, dtype=torch.float64)


def everything(problem: Problem) -> torch.Tensor:
    """Return a basis of all displacements that the supports leave free, (N, D, n)."""
    count = int(problem.free.sum())
    vectors = torch.zeros(*problem.shape, count, dtype=torch.float64)
    vectors[problem.free] = torch.linalg.qr(noise(count, count))[0]
    return vectors


@pytest.fixture(scope="module")
def newton(beam) -> Newton:
    """The beam's reference solver."""
    return Newton(beam(NH), linear="superlu", tol=1e-10)


@pytest.fixture(scope="module")
def snapshots(newton) -> torch.Tensor:
    """Solutions for sixty random loads of three modes, deflections of up to 0.4 L."""
    return solve(
        newton, ModalLoads(newton.linear_solver, n_modes=3).sample(0, range(60))
    ).displacement


@pytest.fixture(scope="module")
def unseen(newton) -> Load:
    """Eight loads that are not among those of the snapshots."""
    return ModalLoads(newton.linear_solver, n_modes=3).sample(1, range(8))


@pytest.fixture(scope="module")
def truth(newton, unseen) -> torch.Tensor:
    """Their solutions."""
    return solve(newton, unseen).displacement


@pytest.fixture(params=[False, True], ids=["alone", "lifted"])
def lift(request, newton) -> LinearSolver | None:
    """None, and the linear solver."""
    return newton.linear_solver if request.param else None


@pytest.mark.parametrize("shape", [(7, 40), (40, 7), (12, 12)], ids=str)
def test_projection_error_is_the_tail_of_the_singular_values(shape):
    fields = noise(*shape) @ torch.diag(0.5 ** torch.arange(shape[1], dtype=torch.float64))
    exact = torch.linalg.svdvals(fields)
    for rank in range(1, 6):
        vectors, values = pod(fields, rank)
        assert vectors.shape == (shape[1], rank)
        assert_close(vectors.T @ vectors, torch.eye(rank, dtype=torch.float64), rtol=0, atol=1e-13)
        assert_close(values, exact, rtol=0, atol=2e-8 * exact[0].item())
        left = (fields - fields @ vectors @ vectors.T).norm().item()
        assert left == pytest.approx(exact[rank:].norm().item(), rel=1e-6)
        assert (vectors.gather(0, vectors.abs().argmax(0, keepdim=True)) > 0).all()


def test_vectors_of_small_singular_values_are_orthogonal():
    left, right = (torch.linalg.qr(noise(n, 8, seed=n))[0] for n in (30, 90))
    sizes = 10.0 ** -torch.arange(8, dtype=torch.float64)
    for fields in (left * sizes @ right.T, right * sizes @ left.T):
        vectors, values = pod(fields, 8)
        assert_close(values[:8], sizes, rtol=0, atol=3e-8)
        assert_close(values[:6], sizes[:6], rtol=1e-3, atol=0)
        assert_close(vectors.T @ vectors, torch.eye(8, dtype=torch.float64), rtol=0, atol=1e-13)


def test_basis_of_single_precision_is_computed_in_double():
    vectors, values = pod(noise(20, 50).float(), 4)
    assert vectors.dtype == values.dtype == torch.float64


@pytest.mark.parametrize("rank", [0, -1, 8])
def test_rank_out_of_range_is_refused(rank):
    with pytest.raises(ValueError, match=f"rank = {rank} must lie between 1 and 7"):
        pod(noise(7, 40), rank)


@pytest.mark.parametrize("large", [5, 2000], ids=["sketched", "exact"])
def test_snapshots_that_are_not_finite_are_refused(monkeypatch, large):
    monkeypatch.setattr("dpl.fem.rom.pod.MIN_SKETCH_SIZE", large)
    with pytest.raises(ValueError, match="finite"):
        pod(noise(150, 400).log(), 2)


@pytest.mark.parametrize("shape", [(160, 400), (400, 160)], ids=str)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_randomised_basis_is_nearly_the_best_one(monkeypatch, shape, dtype):
    fields = (noise(*shape) @ torch.diag(0.8 ** torch.arange(shape[1]).double())).to(dtype)
    best = pod(fields, 6)
    monkeypatch.setattr("dpl.fem.rom.pod.MIN_SKETCH_SIZE", 100)
    before = torch.get_rng_state()
    vectors, values = pod(fields, 6)
    assert torch.equal(before, torch.get_rng_state())
    assert vectors.dtype == values.dtype == torch.float64
    assert_close(vectors.T @ vectors, torch.eye(6).double(), rtol=0, atol=1e-13)
    assert_close(values, best.values[:6], rtol=1e-5, atol=0)
    assert_close(vectors, best.vectors, rtol=0, atol=1e-3)  # of the same signs
    left, least = (
        (fields.double() - fields.double() @ v @ v.T).norm() for v in (vectors, best.vectors)
    )
    assert left < least * (1 + 1e-5)
    assert torch.equal(pod(fields, 6).vectors, vectors)


def test_sparse_weights_reproduce_the_sum():
    """400 columns in 12 dimensions: 12 of them suffice."""
    columns = noise(12, 400).numpy()
    columns[0] = np.abs(columns[0])
    gram, scale = columns.T @ columns, float(np.linalg.norm(columns.sum(axis=1)))
    target = gram.sum(axis=1)
    for tolerance in (1e-1, 1e-3, 1e-5):
        chosen = nonnegative(gram, target, target.sum(), tolerance, scale)
        assert (chosen.weights > 0).all()
        assert len(chosen.cells) <= 12
        sums = columns[:, chosen.cells] @ chosen.weights.numpy()
        error = np.linalg.norm(sums - columns.sum(axis=1)) / scale
        assert error <= tolerance
        assert chosen.error == pytest.approx(error, rel=0.1, abs=1e-7)


@pytest.mark.parametrize("law", [NH, SaintVenantKirchhoff(0.3)], ids=["nh", "svk"])
def test_full_rank_is_newton(beam, pull, law):
    problem = beam(law, 4, 1)
    load = load_of(torch.cat([pull(problem, q) for q in (0.1, 5.0, 40.0)]))
    expected = solve(Newton(problem, linear="superlu", tol=1e-11), load)
    answer = solve(PODGalerkin(problem, everything(problem), reduced_tol=1e-10), load)
    assert answer.converged.all()
    assert answer.load_factor.tolist() == [1, 1, 1]
    assert_close(answer.displacement, expected.displacement, rtol=0, atol=1e-8)


def test_residual_is_orthogonal_to_the_basis(newton, snapshots, unseen, lift):
    problem = newton.problem
    solver = PODGalerkin.fit(problem, snapshots, 12, tolerance=None, lift=lift)
    solver = replace(solver, reduced_tol=1e-10)
    answer = solve(solver, unseen)
    residual = problem.residual(answer.displacement, unseen.force)
    across = torch.einsum("bnd,ndr->br", residual, solver.vectors).norm(dim=1)
    along = torch.einsum("bnd,ndr->br", unseen.force, solver.vectors).norm(dim=1)
    assert (across < 1e-7 * along).all()
    assert (answer.residual > 1e-3).all()  # and not more than orthogonal
    assert not answer.converged.any()
    assert_close(answer.residual, problem.relative_residual(answer.displacement, unseen.force))
    assert_close(answer.volume_ratio, problem.volume_ratio(answer.displacement))


def test_error_falls_with_the_rank(newton, snapshots, unseen, truth, lift):
    found = []
    for rank in (5, 10, 20, 40):
        solver = PODGalerkin.fit(newton.problem, snapshots, rank, tolerance=None, lift=lift)
        found.append(errors(solve(solver, unseen).displacement, truth).median().item())
    assert all(b < 0.6 * a for a, b in pairwise(found))
    assert found[-1] < 2e-3


def test_solution_with_lift_is_more_accurate(newton, snapshots, unseen, truth):
    alone, lifted = (
        PODGalerkin.fit(newton.problem, snapshots, 15, tolerance=None, lift=lift)
        for lift in (None, newton.linear_solver)
    )
    ratio = errors(solve(lifted, unseen).displacement, truth) / errors(
        solve(alone, unseen).displacement, truth
    )
    assert ratio.median() < 0.6


def test_few_positive_weights_reproduce_the_forces_of_snapshots(newton, snapshots):
    """The condition of ECSW itself, by `Problem` alone: f(u) - K(0) u, cell by cell."""
    problem = newton.problem
    solver = PODGalerkin.fit(problem, snapshots, 6, tolerance=1e-2)
    chosen, V = solver.cubature, solver.vectors
    assert (chosen.weights > 0).all()
    assert chosen.error <= 1e-2
    assert len(chosen.cells) <= 16 < len(problem.cells) == 32
    assert (chosen.cells.diff() > 0).all()
    coordinates = torch.einsum("bnd,ndr->br", snapshots, V)
    states = torch.einsum("br,ndr->bnd", coordinates, V)
    forces = []
    for weights in (
        torch.ones(32),
        torch.zeros(32).index_put((chosen.cells,), chosen.weights.float()),
    ):
        of_cells = problem.dV.expand(32, -1) * weights.double()[:, None]
        body = replace(problem, dN=problem.dN.expand(32, -1, -1, -1).contiguous(), dV=of_cells)
        rest = torch.zeros(1, *problem.shape, dtype=torch.float64)
        linear = torch.cat([body.tangent_product(rest, u[None]) for u in states])
        forces.append(torch.einsum("bnd,ndr->br", body.internal_force(states) - linear, V))
    whole = torch.einsum("bnd,ndr->br", problem.internal_force(states), V).norm(dim=1)
    error = (forces[1] - forces[0]).norm(dim=1) / whole
    assert error.square().mean().sqrt() < 3e-2  # in another norm than that of the choice


def test_few_cells_give_nearly_the_same_solution(newton, snapshots, unseen, lift):
    solvers = {
        tolerance: PODGalerkin.fit(newton.problem, snapshots, 8, tolerance=tolerance, lift=lift)
        for tolerance in (None, 1e-2, 1e-3)
    }
    whole = solve(solvers[None], unseen).displacement
    found = [errors(solve(solvers[t], unseen).displacement, whole).median() for t in (1e-2, 1e-3)]
    assert found[1] < found[0] < 1e-2
    assert found[1] < 2e-3
    counts = [len(solvers[t].cubature.cells) for t in (1e-2, 1e-3)]
    assert counts[0] < counts[1] < 32


def test_few_cells_are_exact_for_small_loads(newton, snapshots, unseen):
    """The linear part is that of the whole body for any cells."""
    load = load_of(1e-7 * unseen.force)
    whole = PODGalerkin.fit(newton.problem, snapshots, 8, tolerance=None)
    poor = replace(whole, cubature=Cubature(torch.tensor([3]), torch.tensor([2.0]), 1.0))
    answers = [solve(solver, load).displacement for solver in (whole, poor)]
    assert errors(*answers).max() < 1e-5


def test_a_linear_law_needs_no_cells(beam, pull):
    problem = beam(LinearElastic(0.3), 4, 1)
    rest = LinearSolver(problem, linear="superlu")
    fields = torch.stack([rest.solve(pull(problem, q)[0]) for q in (1.0, 2.0)])
    solver = PODGalerkin.fit(problem, fields, 1)
    assert len(solver.cubature.cells) == 1
    answer = solve(solver, load_of(pull(problem, 3.0)))
    assert answer.converged.all()
    assert_close(answer.displacement, 3 * fields[:1], rtol=0, atol=1e-12)


def test_forces_of_weighted_cells_have_an_energy(newton, snapshots):
    """The reduced tangent is the slope of the reduced force, and symmetric."""
    solver = PODGalerkin.fit(newton.problem, snapshots, 6, tolerance=1e-2)
    load = solver.reduced_problem.reduce(torch.zeros(newton.problem.shape, dtype=torch.float64))
    y, way = 3e-3 * noise(6), noise(6, seed=1)
    at, ahead, back = (
        solver.reduced_problem.state(load, y + h * way, 0.0) for h in (0.0, 1e-6, -1e-6)
    )
    cells, rest = solver.reduced_problem.cells, solver.reduced_problem.stiffness_error

    def energy(state):
        return (
            cells.problem.energy(state.cell_displacement).item()
            + (state.y @ rest @ state.y).item() / 2
        )

    slope = (energy(ahead) - energy(back)) / 2e-6
    assert slope == pytest.approx((at.internal @ way).item(), rel=1e-6)
    system = cells.problem.linearise(at.cell_displacement)
    tangent = cells.reduced(cells.tangents(system.tangent[0])) + rest
    assert_close(tangent, tangent.T, rtol=0, atol=1e-6)
    assert_close(tangent @ way, (ahead.internal - back.internal) / 2e-6, rtol=1e-5, atol=1e-5)


def test_stiffness_at_rest_is_the_identity(newton, snapshots):
    """With all cells and with few, in the coordinates of the iteration."""
    for tolerance in (None, 1e-2):
        solver = PODGalerkin.fit(newton.problem, snapshots, 6, tolerance=tolerance)
        load = solver.reduced_problem.reduce(torch.zeros(newton.problem.shape, dtype=torch.float64))
        y = 1e-9 * noise(6)
        assert_close(solver.reduced_problem.state(load, y, 0.0).internal, y, rtol=1e-5, atol=1e-15)


@pytest.mark.parametrize("lifted", [False, True])
def test_moved_supports_are_an_offset_of_the_subspace(lifted):
    """A bar stretched in steps of its ends, as far as Newton goes."""
    mesh = box([1.0, 1.0, 1.0], [3, 3, 3])
    ends = [DirichletBC(Plane(0, "min")), DirichletBC(Plane(0, "max"), [0.5, 0.0, 0.0])]
    problem = Problem.build(mesh, NH, supports=ends)
    none = load_of(torch.zeros(1, *problem.shape, dtype=torch.float64))
    answer = solve(Newton(problem, linear="superlu"), none)
    lift = LinearSolver(problem, linear="superlu") if lifted else None
    solver = PODGalerkin(problem, everything(problem), None, lift, reduced_tol=1e-10)
    found = solve(solver, none)
    assert found.converged.all()
    assert_close(found.displacement, answer.displacement, rtol=0, atol=1e-8)
    few = PODGalerkin.fit(problem, answer.displacement, 1, lift=lift)
    assert_close(solve(few, none).displacement, answer.displacement, rtol=0, atol=1e-3)


@pytest.mark.parametrize("tolerance", [None, 1e-3])
def test_springs_are_included(newton, tolerance):
    mesh = box([100.0, 25.0, 25.0], [5, 2, 2])
    problem = Problem.build(mesh, NH, supports=[RobinBC(Plane(0, "min"), 0.05)])
    solver = Newton(problem, linear="superlu", tol=1e-10)
    force = 1e-5 * torch.stack([problem.points * k for k in (1.0, 2.0, -2.0, 5.0)])
    load = load_of(force + 2e-5 * noise(4, *problem.shape))
    truth = solve(solver, load).displacement
    answer = solve(PODGalerkin.fit(problem, truth, 4, tolerance=tolerance), load)
    assert errors(answer.displacement, truth).max() < 2e-3


def test_huge_load_ends_as_a_value(newton, snapshots, unseen, lift):
    for tolerance in (None, 1e-2):
        solver = PODGalerkin.fit(newton.problem, snapshots, 6, tolerance=tolerance, lift=lift)
        for factor in (1e4, 1e9):
            answer = solve(solver, load_of(factor * unseen.force[:1]))
            assert not answer.converged.any()
            assert answer.status.item() == Status.NOT_CONVERGED
            assert answer.displacement.isfinite().all()
        lost = solver.reduced(1e9 * unseen.force[0])
        assert lost.load_factor < 1
        assert lost.residual > solver.reduced_tol
        assert lost.iterations <= solver.max_total_iter


def test_force_that_is_no_number_ends_as_a_value(newton, snapshots, unseen):
    solver = PODGalerkin.fit(newton.problem, snapshots, 6)
    answer = solve(solver, load_of(unseen.force[:1] * np.nan))
    assert not answer.converged.any()


def test_zero_load_costs_nothing(newton, snapshots):
    solver = PODGalerkin.fit(newton.problem, snapshots, 6)
    answer = solve(solver, load_of(torch.zeros(1, *newton.problem.shape, dtype=torch.float64)))
    assert answer.converged.all()
    assert answer.iterations.item() == 0
    assert not answer.displacement.any()


def test_batch_is_solved_like_its_members(newton, snapshots, unseen, lift):
    solver = PODGalerkin.fit(newton.problem, snapshots, 8, tolerance=1e-2, lift=lift)
    batch = solve(solver, unseen)
    for k in range(len(unseen.force)):
        member = solve(solver, Load(unseen.force[k, None], unseen.young[k, None]))
        for name in ("displacement", "residual", "volume_ratio", "iterations", "factorisations"):
            assert torch.equal(getattr(member, name)[0], getattr(batch, name)[k]), name


def test_pickled_solver_has_the_same_solutions(newton, snapshots, unseen):
    solver = PODGalerkin.fit(newton.problem, snapshots, 8, lift=newton.linear_solver)
    answer = solve(solver, unseen)
    copy = pickle.loads(pickle.dumps(solver))
    assert torch.equal(solve(copy, unseen).displacement, answer.displacement)


def test_reuse_of_tangents_changes_no_solution(newton, snapshots, unseen):
    solver = PODGalerkin.fit(newton.problem, snapshots, 8)
    fresh, reused = (
        solve(replace(solver, factor_reuse_tol=reuse, reduced_tol=1e-9), unseen)
        for reuse in (1e-9, 0.1)
    )
    assert_close(fresh.displacement, reused.displacement, rtol=0, atol=1e-8)
    assert reused.factorisations.sum() < fresh.factorisations.sum()


@pytest.mark.parametrize("rank", [0, 61])
def test_wrong_rank_is_refused(newton, snapshots, rank):
    with pytest.raises(ValueError, match=f"rank = {rank} must lie between 1 and 60"):
        PODGalerkin.fit(newton.problem, snapshots, rank)


def test_body_with_rigid_body_modes_is_refused(unseen):
    problem = Problem.build(box([1.0, 1.0, 1.0], [2, 2, 2]), NH)
    solver = PODGalerkin(problem, rigid_body_modes(problem.points)[0])
    with pytest.raises(ValueError, match="fix the rigid body modes"):
        solver.reduced(torch.zeros(problem.shape, dtype=torch.float64))


@pytest.mark.parametrize(
    "option",
    [
        {"tol": 0},
        {"reduced_tol": 1},
        {"min_detF_ratio": 0},
        {"min_load_step": 2},
        {"max_total_iter": 0},
        {"factor_reuse_tol": -1},
    ],
    ids=str,
)
def test_option_out_of_range_is_an_error_that_names_it(newton, snapshots, option):
    with pytest.raises(ValueError, match=next(iter(option))):
        PODGalerkin(newton.problem, snapshots[:4].movedim(0, -1), **option)


def test_basis_of_another_body_is_refused(newton, beam, snapshots):
    with pytest.raises(ValueError, match=r"vectors\.shape"):
        PODGalerkin(beam(NH, 4, 1), snapshots[:4].movedim(0, -1))


def test_cells_are_chosen_among_candidates(newton, snapshots):
    """The weighted candidates reproduce the forces of all cells."""
    problem = newton.problem
    vectors = PODGalerkin.fit(problem, snapshots, 6, tolerance=None).vectors
    some = torch.arange(0, len(problem.cells), 2)  # too few for 1e-2
    basis = vectors[problem.free]
    states = torch.zeros_like(snapshots)
    states[:, problem.free] = snapshots[:, problem.free] @ basis @ basis.T
    chosen = cubature(problem, vectors, states, 1e-2, some)
    assert torch.isin(chosen.cells, some).all()
    assert chosen.error < 0.2
    every = cubature(problem, vectors, states, 1e-2, torch.arange(len(problem.cells)))
    known = cubature(problem, vectors, states, 1e-2)
    assert torch.equal(every.cells, known.cells)
    assert_close(every.weights, known.weights, rtol=1e-3, atol=0)

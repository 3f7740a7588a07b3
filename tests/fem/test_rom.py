"""Laws of reduced bases: the best subspace, and few cells with its forces."""

from dataclasses import replace

import pytest
import torch
from solving import noise, rest
from torch.testing import assert_close

from dpl import fem
from dpl.fem.rom.ecsw import cubature
from dpl.fem.rom.pod import orthonormal_fields, pod


def reduced(problem: fem.Problem, fields: torch.Tensor, rank: int) -> tuple[torch.Tensor, ...]:
    """Return an orthonormal basis of fields (S, N, D), (N, D, R), and their projections onto it."""
    vectors = orthonormal_fields(pod(fields[:, problem.free], rank).vectors, problem.free)
    return vectors, torch.einsum("bnd,ndr,mer->bme", fields, vectors, vectors)


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


def test_invalid_ranks_and_snapshots_are_refused(monkeypatch):
    for rank in (0, -1, 8):
        with pytest.raises(ValueError, match=f"rank = {rank} must lie between 1 and 7"):
            pod(noise(7, 40), rank)
    for large in (5, 2000):  # sketched and exact
        monkeypatch.setattr("dpl.fem.rom.pod.MIN_SKETCH_SIZE", large)
        with pytest.raises(ValueError, match="finite"):
            pod(noise(150, 400).log(), 2)


@pytest.mark.parametrize(
    ("shape", "dtype"), [((160, 400), torch.float64), ((400, 160), torch.float32)], ids=str
)
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


def test_few_positive_weights_reproduce_the_forces_of_snapshots(newton, snapshots):
    """The condition of ECSW itself, by `Problem` alone: f(u) - K(0) u, cell by cell."""
    problem = newton.problem
    V, states = reduced(problem, snapshots, 6)
    chosen = cubature(problem, V, states, 1e-2)
    assert (chosen.weights > 0).all()
    assert chosen.error <= 1e-2
    assert len(chosen.cells) <= 16 < len(problem.cells) == 32
    assert (chosen.cells.diff() > 0).all()
    forces = []
    for weights in (
        torch.ones(32),
        torch.zeros(32).index_put((chosen.cells,), chosen.weights.float()),
    ):
        of_cells = problem.dV.expand(32, -1) * weights.double()[:, None]
        body = replace(problem, dN=problem.dN.expand(32, -1, -1, -1).contiguous(), dV=of_cells)
        zero = rest(problem)
        linear = torch.cat([body.tangent_product(zero, u[None]) for u in states])
        forces.append(torch.einsum("bnd,ndr->br", body.internal_force(states) - linear, V))
    whole = torch.einsum("bnd,ndr->br", problem.internal_force(states), V).norm(dim=1)
    error = (forces[1] - forces[0]).norm(dim=1) / whole
    assert error.square().mean().sqrt() < 3e-2  # in another norm than that of the choice


def test_a_linear_law_needs_no_cells(beam, pull):
    problem = beam(fem.LinearElastic(0.3), 4, 1)
    linear = fem.LinearSolver(problem, linear="superlu")
    fields = torch.stack([linear.solve(pull(problem, q)[0]) for q in (1.0, 2.0)])
    assert len(cubature(problem, *reduced(problem, fields, 1), 1e-3).cells) == 1


def test_cells_are_chosen_among_candidates(newton, snapshots):
    """The weighted candidates reproduce the forces of all cells."""
    problem = newton.problem
    vectors, states = reduced(problem, snapshots, 6)
    some = torch.arange(0, len(problem.cells), 2)  # too few for 1e-2
    chosen = cubature(problem, vectors, states, 1e-2, some)
    assert torch.isin(chosen.cells, some).all()
    assert chosen.error < 0.2
    every = cubature(problem, vectors, states, 1e-2, torch.arange(len(problem.cells)))
    known = cubature(problem, vectors, states, 1e-2)
    assert torch.equal(every.cells, known.cells)
    assert_close(every.weights, known.weights, rtol=1e-3, atol=0)

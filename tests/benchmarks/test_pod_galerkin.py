"""POD-Galerkin, an opponent in comparisons: equilibrium in a subspace, on few cells."""

from itertools import pairwise

import pytest
import torch
from torch.testing import assert_close

from benchmarks.pod_galerkin import TOL, PODGalerkin
from dpl import fem
from dpl.fem.rom.ecsw import Cubature

NH = fem.NeoHookeanLn(0.3)


def errors(answer: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Return the relative error of each displacement, (B,)."""
    return (answer - truth).flatten(1).norm(dim=1) / truth.flatten(1).norm(dim=1)


def solutions(solver: PODGalerkin, force: torch.Tensor) -> torch.Tensor:
    """Return the equilibria in the subspace under forces (B, N, D)."""
    return torch.stack([solver.reduced(one).displacement for one in force])


def newton(mesh=None, **supports) -> fem.Newton:
    """Return Newton's method for a beam of 32 hexahedra that is held at one end."""
    mesh = fem.box([4.0, 1.0, 1.0], [9, 3, 3]) if mesh is None else mesh
    problem = fem.Problem.build(mesh, NH, **(supports or {"fixed": fem.Plane(0, "min")}))
    return fem.Newton(problem, linear="superlu", tol=1e-10)


@pytest.fixture(scope="module")
def solver() -> fem.Newton:
    return newton()


@pytest.fixture(scope="module")
def loads(solver) -> fem.ModalLoads:
    return fem.ModalLoads(solver.linear_solver, n_modes=3)


@pytest.fixture(scope="module")
def snapshots(solver, loads) -> torch.Tensor:
    return fem.solve(solver, loads.sample(0, range(60))).displacement


@pytest.fixture(scope="module")
def unseen(loads) -> fem.Load:
    return loads.sample(1, range(6))


def test_residual_on_all_cells_is_orthogonal_to_the_basis(solver, snapshots, unseen):
    problem, lift = solver.problem, solver.linear_solver
    basis = torch.linalg.qr(snapshots[:8, problem.free].T).Q
    vectors = torch.zeros(*problem.shape, 8, dtype=torch.float64)
    vectors[problem.free] = basis
    every = Cubature(torch.arange(32), torch.ones(32, dtype=torch.float64), 0.0)
    u = solutions(PODGalerkin(problem, vectors, every, lift), unseen.force)
    residual = problem.residual(u, unseen.force)
    across, along = (
        torch.einsum("bnd,ndr->br", field, vectors).norm(dim=1)
        for field in (residual, unseen.force)
    )
    assert (across < 10 * TOL * along).all()
    assert (residual.flatten(1).norm(dim=1) > 100 * across).all()  # and not more than orthogonal


def test_error_falls_with_rank_and_cells(solver, snapshots, unseen):
    truth, found, counts = fem.solve(solver, unseen).displacement, [], []
    for rank, tolerance in ((5, 1e-2), (12, 3e-3), (30, 1e-3)):
        reduced = PODGalerkin.fit(
            solver.problem, snapshots, rank, tolerance=tolerance, lift=solver.linear_solver
        )
        found.append(float(errors(solutions(reduced, unseen.force), truth).median()))
        counts.append(len(reduced.chosen.cells))
    assert all(b < 0.6 * a for a, b in pairwise(found))
    assert found[-1] < 2e-3
    assert counts == sorted(counts)


def test_moved_supports_and_springs_are_included():
    mesh = fem.box([1.0, 1.0, 1.0], [3, 3, 3])
    moved = fem.DirichletBC(fem.Plane(0, "max"), [0.3, 0.0, 0.0])
    for held in (fem.DirichletBC(fem.Plane(0, "min")), fem.RobinBC(fem.Plane(0, "min"), 0.05)):
        solver = newton(mesh, supports=[held, moved])
        none = fem.Load(torch.zeros(1, *solver.problem.shape).double(), torch.ones(1).double())
        truth = fem.solve(solver, none).displacement
        reduced = PODGalerkin.fit(
            solver.problem, truth, 1, tolerance=1e-3, lift=solver.linear_solver
        )
        assert_close(solutions(reduced, none.force), truth, rtol=0, atol=1e-3)


def test_huge_load_ends_as_a_value(solver, snapshots, unseen):
    reduced = PODGalerkin.fit(
        solver.problem, snapshots, 6, tolerance=1e-2, lift=solver.linear_solver
    )
    lost = reduced.reduced(1e9 * unseen.force[0])
    assert lost.displacement.isfinite().all()
    assert lost.load_factor < 1
    assert lost.residual > TOL


def test_a_body_with_a_range_is_refused(solver, snapshots):
    mesh, law = fem.box([4.0, 1.0, 1.0], [9, 3, 3]), fem.NeoHookeanLn([0.2, 0.4])
    ranged = fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"))
    with pytest.raises(ValueError, match=r"poisson = \[0\.2, 0\.4\] must be one number"):
        PODGalerkin.fit(ranged, snapshots, 6, tolerance=1e-2, lift=solver.linear_solver)

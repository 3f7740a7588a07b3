"""Mean dilatation: volume ratios projected in linear and quadratic cells, and Newton's method."""

import math
import warnings
from dataclasses import replace
from itertools import cycle

import numpy as np
import pytest
import torch
from laws import ISOTROPIC, LAWS
from solving import Uncompiled, assert_derivatives, load_of, poisson, uncompiled, without_load
from torch.testing import assert_close

from benchmarks.verification.dilatation import MEMBRANE, solved
from benchmarks.verification.taylor_hood import taylor_hood
from dpl import fem

CELLS = [("quad", 1), ("quad", 2), ("hexahedron", 1), ("triangle", 2), ("tetra", 2)]
BODIES = [(*cell, "neo_hookean_ln") for cell in CELLS]
BODIES += [(*cell, name) for cell, name in zip(cycle(CELLS), LAWS)]


@pytest.fixture(params=BODIES, ids=str)
def dilated(request, grid) -> fem.Problem:
    """Bodies of unequal cells with projected volume ratios: each element, each law."""
    cell, degree, name = request.param
    mesh = grid(cell, 2, 0.15)
    return fem.Problem.build(
        mesh,
        LAWS[name],
        fixed=lambda points: points[:, 0] < 0.2,
        degree=degree,
        length=1.0,
        mean_dilatation=True,
    )


def standard(problem: fem.Problem) -> fem.Problem:
    """Return the same body whose points keep their own volume ratio."""
    return replace(problem, volume_functions=None)


def test_force_and_tangent_of_mean_dilatation_are_slopes_of_energy_and_force(dilated, bend):
    """Variational and therefore symmetric, unlike the F-bar of de Souza Neto (1996)."""
    u, v = bend(dilated.points, 2), bend(dilated.points, 2, seed=1)
    assert (dilated.volume_ratio(u) > 0.3).all()
    assert_derivatives(dilated, u, v, rtol=1e-9)
    force, plain = dilated.internal_force(u), standard(dilated).internal_force(u)
    assert (force - plain).abs().max() > 1e-4


def test_mean_dilatation_changes_no_homogeneous_deformation(dilated):
    dim = dilated.shape[1]
    random = torch.Generator().manual_seed(2)
    H = torch.rand(dim, dim, generator=random, dtype=torch.float64) * 0.4 - 0.2
    u, plain = (dilated.points @ H.T)[None], standard(dilated)
    for method in ("energy", "internal_force", "stress", "volume_ratio"):
        found, expected = getattr(dilated, method)(u), getattr(plain, method)(u)
        assert_close(found, expected, rtol=1e-11, atol=1e-13)


# The laws of the compiled loops: small strains, each kind of volume term, and fibres. The loops of
# a law are compiled for trilinear hexahedra and for all other cells: one of both is enough.
FEW = ["linear_elastic", "saint_venant_kirchhoff", "neo_hookean_ln", "neo_hookean_iso_k2"]
FEW += ["ogden_k2", *sorted(set(LAWS) - set(ISOTROPIC))]
TABLES = [cell for cell in CELLS if cell[0] not in ("quad", "hexahedron")] + [CELLS[0]]


@pytest.mark.parametrize(
    ("element", "name"),
    [*zip(cycle(TABLES), FEW), (("tetra", 2), "neo_hookean_ln"), (("hexahedron", 1), FEW[2])],
    ids=str,
)
def test_mean_dilatation_passes_the_patch_test(element, name, grid):
    """The boundary is moved linearly, the inner nodes follow exactly."""
    (cell, degree), law = element, LAWS[name]
    mesh = grid(cell, 3 if degree == 1 else 2, 0.2, inside=True)
    dim = len(mesh.p)
    H = np.array([[0.2, 0.2, -0.1], [0.05, -0.05, 0.15], [-0.08, 0.12, 0.1]])[:dim, :dim]
    bare = fem.Problem.build(mesh, law, degree=degree, length=1.0)
    problem = fem.Problem.build(
        mesh, law, fixed=bare.boundary.numpy(), prescribed=bare.points.numpy() @ H.T,
        degree=degree, length=1.0, mean_dilatation=True,
    )  # fmt: skip
    answer = without_load(problem, tol=1e-12, linear="superlu")
    assert answer.converged.all()
    expected = problem.points @ torch.from_numpy(H).T
    assert_close(answer.displacement[0], expected, rtol=0, atol=1e-11)
    stress = problem.stress(answer.displacement)
    assert_close(stress, stress[:, :1, :1].expand_as(stress), rtol=0, atol=1e-10)


@pytest.mark.parametrize("cell", ["quad", "hexahedron"])
def test_mean_dilatation_does_not_lock(cell):
    """At nu = 0.4999 the compliance is within 6 % of quadratic cells, which hardly lock."""
    size, nodes = ([10.0, 2.0], [21, 5]) if cell == "quad" else ([10.0, 2.0, 2.0], [21, 5, 3])
    build = fem.rectangle if cell == "quad" else fem.box
    law, sags = fem.NeoHookeanLn(0.4999), {}
    options = {"locked": {}, "dilated": {"mean_dilatation": True}, "quadratic": {"degree": 2}}
    for name, option in options.items():
        mesh = build(size, nodes, cell)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            problem = fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"), **option)
        value = [0.0, -1e-6, 0.0][: len(size)]
        force = fem.Traction(fem.Plane(0, "max"), value).on(problem)
        sags[name] = (fem.LinearSolver(problem, linear="superlu").solve(force) * force).sum().item()
    assert sags["locked"] < 0.5 * sags["quadratic"]
    assert sags["dilated"] == pytest.approx(sags["quadratic"], rel=0.06)


@pytest.mark.parametrize("cell", ["triangle", "tetra"])
def test_mean_dilatation_is_refused_of_linear_simplices(grid, cell):
    with pytest.raises(ValueError, match=r"mean_dilatation = true must .* degree=2 .*hexahedra"):
        fem.Problem.build(grid(cell), fem.NeoHookeanLn(0.3), mean_dilatation=True)


@pytest.mark.parametrize("nu", [0.3, 0.45, 0.49, 0.4999])
def test_cook_s_membrane_of_quadratic_triangles_has_the_tip_of_a_fine_mesh(nu):
    """Within 0.5 % of quadratic quadrilaterals with half their size, in at most 7 iterations."""
    tip, count = solved(MEMBRANE, nu, 8, "triangle", 2)
    fine, _ = solved(MEMBRANE, nu, 16, "quad", 2)
    assert tip == pytest.approx(fine, rel=5e-3)
    assert count <= 7


def test_forces_of_mean_dilatation_are_objective(dilated, bend):
    """A rigid motion rotates them; tolerance 1e-12."""
    dim, u = dilated.shape[1], bend(dilated.points)
    if not dilated.material.finite:
        pytest.skip("forces of small strains are not objective")
    skew = torch.tensor([[0, -0.4, 0.9], [0.4, 0, -0.2], [-0.9, 0.2, 0]], dtype=torch.float64)
    turn = torch.matrix_exp(skew[:dim, :dim])
    force = dilated.internal_force(u)
    moved = (dilated.points + u) @ turn.T + 0.3 - dilated.points
    assert (dilated.internal_force(moved) - force @ turn.T).norm() < 1e-12 * force.norm()


def test_linear_law_of_mean_dilatation_is_linear(beam, pull):
    """A linear problem converges in exactly one iteration."""
    problem = beam(fem.LinearElastic(0.3), mean_dilatation=True)
    answer = fem.solve(fem.Newton(problem), load_of(pull(problem, 20.0)))
    assert answer.iterations.item() == 1


def test_beam_of_mean_dilatation_keeps_its_volume(beam, pull):
    """The volume ratio of each cell tends to 1 as nu tends to 1/2, that of its points need not."""
    problem = beam(fem.NeoHookeanLn(0.4999), 4, 2, mean_dilatation=True)
    force = pull(problem, 20.0)
    answer = fem.solve(fem.Newton(problem), load_of(force))
    assert answer.status.item() == fem.Status.CONVERGED
    F = torch.einsum("eai,eqaj->eqij", answer.displacement[0][problem.cells], problem.dN)
    J = torch.linalg.det(F + torch.eye(3, dtype=torch.float64))
    weight = problem.dV / problem.dV.sum(dim=1, keepdim=True)
    assert ((J * weight).sum(dim=1) - 1).abs().max() < 1e-3
    assert (J - 1).abs().max() > 1e-2


COMPILED = BODIES[: len(CELLS)]
COMPILED += [(*cell, name) for cell, name in zip(cycle(TABLES), FEW) if name != "ogden_k2"]


@pytest.mark.parametrize("dilated", COMPILED, indirect=True, ids=str)
def test_loops_of_mean_dilatation_are_those_of_the_tensors(dilated, bend):
    """Force and tangent, and those of mixed points after two steps."""
    plain = uncompiled(dilated)
    u, v, w = (0.3 * bend(dilated.points, seed=seed) for seed in range(3))
    gaps = [None, None]
    for step, length in ((v, 1.0), (w, 0.25)):
        gaps = [
            body.update_strain_gap(gap, length, step, u)
            for body, gap in zip((dilated, plain), gaps, strict=True)
        ]
    for pair in [(None, None)] + [gaps] * dilated.material.has_response:
        found, expected = dilated.linearise(u, pair[0]), plain.linearise(u, pair[1])
        assert found.valid.item()
        for name in ("force", "tangent"):
            one, other = getattr(found, name), getattr(expected, name)
            assert (one - other).abs().max() < 1e-13 * other.abs().max()


def test_volume_gap_is_what_the_linear_change_of_volume_falls_short_of(grid, bend):
    body = Uncompiled.build(
        grid("quad", 2, 0.15), fem.NeoHookeanLn(0.4), degree=2, length=1.0, mean_dilatation=True
    )
    u, v = bend(body.points), bend(body.points, seed=1)

    def volumes(displacement):
        F = body.discretisation.gradient(displacement) + torch.eye(3, dtype=torch.float64)
        return body.discretisation.volumes.coefficients(torch.linalg.det(F))

    slope = torch.func.jvp(volumes, (u,), (v,))[1]
    end = u + 0.25 * v
    first = body.update_strain_gap(None, 1.0, v, u + v)
    found = body.update_strain_gap(first, 0.25, v, end).volume
    expected = volumes(end) - volumes(u) - 0.25 * slope + 0.75 * first.volume
    assert_close(found, expected, rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize(
    ("cell", "degree"), [("hexahedron", 1), ("hexahedron", 2), ("tetra", 2)], ids=str
)
def test_iterations_do_not_depend_on_the_bulk_modulus(cell, degree):
    """A cantilever that bends by half of its length; bulk over shear modulus from 10 to 1e5."""
    mesh, counts = fem.box([4.0, 1.0, 1.0], [13, 4, 4] if degree == 1 else [7, 3, 3], cell), []
    for bulk in (10.0, 1e3, 1e5):
        problem = fem.Problem.build(
            mesh,
            fem.NeoHookeanIsoK2(poisson(bulk)),
            fixed=fem.Plane(0, "min"),
            degree=degree,
            length=1.0,
            mean_dilatation=True,
            follower_loads=[fem.FollowerPressure(fem.Plane(2, "max"), 4e-3)],
        )
        solution = without_load(problem, tol=1e-6)
        assert solution.converged.item()
        counts.append(solution.iterations.item())
    assert max(counts) <= min(counts) + 4
    assert max(counts) <= 9


@pytest.mark.parametrize("name", sorted(set(LAWS) - set(ISOTROPIC)))
def test_laws_with_fibres_converge_near_incompressibility(name):
    """Bulk over shear modulus of 1e2 and 1e5, from rest and without a load step."""
    law, found = LAWS[name], []
    mu = law.mu.item()
    for ratio in (1e2, 1e5):
        has_bulk = vars(law.matrix).get("bulk") is not None
        nearly = {"bulk": ratio * mu} if has_bulk else {"poisson": poisson(ratio)}
        stiff = replace(law, matrix=replace(law.matrix, **nearly))
        problem = fem.Problem.build(
            fem.box([4.0, 1.0, 1.0], [5, 2, 2]),
            stiff,
            fixed=fem.Plane(0, "min"),
            degree=2,
            length=1.0,
            mean_dilatation=True,
            follower_loads=[fem.FollowerPressure(fem.Plane(2, "max"), 0.01 * mu)],
        )
        solution = without_load(problem, tol=1e-6)
        assert solution.converged.item()
        assert solution.iterations.item() <= 10
        found.append(solution.displacement.abs().max().item())
    assert found[0] == pytest.approx(found[1], rel=0.02)
    assert found[1] > 0.5


def muscle(bulk: float, **options) -> fem.Problem:
    """Return a bar of Guccione's law whose fibres turn across it, contracting by 5 times C."""

    def turning(points):
        angle = np.pi * (points[:, 2] - 0.5)
        return np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)

    law = fem.FibreReinforced(
        fem.VolumetricK4(bulk), fem.Guccione(1.0, 8.0, 2.0, 4.0), fem.FibreFunction(turning)
    )
    return fem.Problem.build(
        fem.box([2.0, 1.0, 1.0], [5, 3, 3]),
        law,
        supports=[fem.DirichletBC(fem.Plane(0, "min"))],
        degree=2,
        length=1.0,
        follower_loads=[fem.ActiveStress(5.0)],
        mean_dilatation=True,
        **options,
    )


def test_contraction_near_incompressibility_converges_from_rest():
    """Bulk over shear modulus of 1e4 and more; the volume of each cell is kept."""
    problem = muscle(1e5)
    solution = without_load(problem, tol=1e-6)
    assert solution.converged.item()
    change = problem.discretisation.gradient(solution.displacement)
    J = torch.linalg.det(change + torch.eye(3, dtype=torch.float64))
    mean = (J * problem.dV).sum(-1) / problem.dV.sum(-1)
    assert (mean - 1).abs().max() < 1e-3
    assert solution.displacement.abs().max() > 0.3


def test_bulk_modulus_of_the_points_is_that_of_fibres_and_of_quadratic_simplices(grid):
    """It vanishes from the energy of a homogeneous change of volume."""
    law = fem.FibreReinforced(
        fem.VolumetricK4(9.0), fem.Guccione(1.0, 8.0, 2.0, 4.0), fem.ConstantFibres([1, 0, 0])
    )
    assert law.point_bulk.item() == pytest.approx(2 * law.mu.item())
    assert fem.NeoHookeanLn(0.3).point_bulk == 0.0
    for cell, part in (("tetra", 0.5), ("hexahedron", 0.0)):
        body = fem.Problem.build(
            grid(cell), fem.NeoHookeanLn(0.3), degree=2, length=1.0, mean_dilatation=True
        )
        stays = body.discretisation.volumes.point_bulk(body.material)
        assert stays.item() == pytest.approx(part * body.material.mu.item())
    problem = muscle(9.0)
    u = 0.05 * problem.points[None]
    assert_close(problem.energy(u), replace(problem, volume_functions=None).energy(u))


@pytest.mark.parametrize("cell", ["triangle", "tetra"])
def test_taylor_hood_elements_have_the_pressure_of_a_homogeneous_stretch(grid, cell):
    """P = -kappa (J - 1) of NHiso-k2; the reference of the verification page."""
    mesh = grid(cell)
    bare = fem.Problem.build(mesh, fem.NeoHookeanIsoK2(0.45), degree=2, length=1.0)
    dim = mesh.dim()
    given = bare.points.numpy() @ np.diag([0.1, -0.05, 0.02][:dim])
    problem = fem.Problem.build(
        mesh, bare.material, fixed=bare.boundary.numpy(), prescribed=given, degree=2, length=1.0
    )
    found = taylor_hood(problem, 0.45)
    J = math.prod([1.1, 0.95, 1.02][:dim])
    assert_close(found.displacement.numpy(), given, rtol=0, atol=1e-9)
    assert found.pressure == pytest.approx((1 - J) / (3 * (1 - 2 * 0.45)), rel=1e-8)

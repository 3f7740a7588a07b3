"""Residual stress: closed forms, derivatives, equilibrium at u = 0, files."""

import warnings

import numpy as np
import pytest
import skfem
import torch
from scipy.optimize import brentq
from torch import Tensor
from torch.testing import assert_close

from dpl import fem
from dpl.fem.mesh.writing import write_mesh_exactly
from dpl.scene import Scene
from tests.laws import LAWS

LAW = fem.NeoHookeanLn(0.3)
GROWTH = 1.2, 1.1, 1.3
BODIES = {
    "hexahedra": fem.box([1.0, 0.3, 0.3], [4, 3, 3]),
    "quadratic hexahedra": skfem.MeshHex2.from_mesh(fem.box([1.0, 0.3, 0.3], [3, 2, 2])),
    "quadratic tetrahedra": skfem.MeshTet2.from_mesh(fem.box([1.0, 0.3, 0.3], [3, 2, 2], "tetra")),
    "quadrilaterals": fem.rectangle([1.0, 0.3], [5, 3]),
}


def near(mesh: skfem.Mesh, *points: list[float]) -> list[int]:
    """Return the nodes at some points."""
    return [int(np.abs(mesh.p.T - point).max(axis=1).argmin()) for point in points]


def bent(points: np.ndarray) -> np.ndarray:
    """Return the prestretch of growth along x that varies across and along the body."""
    G = np.tile(np.eye(3), (len(points), 1, 1))
    G[:, 0, 0] = 1 / (1 + 0.4 * points[:, -1] * np.cos(2 * points[:, 0]))
    return G


@pytest.fixture(scope="module")
def beam() -> tuple[fem.Problem, fem.Problem]:
    """A beam with residual bending stress, and the same mesh without."""
    flat = fem.Problem.build(fem.box([1.0, 0.25, 0.25], [9, 3, 3]), LAW, fixed=fem.Plane(0, "min"))
    mesh, stretch = fem.relaxed(flat, bent)
    fixed = ~flat.free.numpy()
    return tuple(
        fem.Problem.build(mesh, law, fixed=fixed) for law in (fem.Prestretched(LAW, stretch), LAW)
    )


def loads_on(problem: fem.Problem, size: float) -> fem.Load:
    force = torch.zeros(1, *problem.shape, dtype=torch.float64)
    (corner,) = near(problem.mesh_in_metres, [1.0, 0.0, 0.25])
    force[0, corner] = size * torch.tensor([0.3, 0.5, -1.0], dtype=torch.float64)
    return fem.Load(force, torch.ones(1, dtype=torch.float64))


# ------------------------------------------------------------------ the law


@pytest.mark.parametrize("name", ["neo_hookean_ln", "yeoh_k2", "ogden_k2", "guccione"])
def test_stress_and_moduli_are_derivatives_of_the_energy(name):
    random = torch.Generator().manual_seed(0)
    G, H = 0.2 * torch.rand(2, 5, 4, 3, 3, generator=random, dtype=torch.float64)
    law, H = fem.Prestretched(LAWS[name], G + torch.eye(3)), H[None]
    assert_close(law.stress(H), torch.func.grad(lambda x: law.energy(x).sum())(H))
    direction = torch.rand(H.shape, generator=random, dtype=torch.float64)
    slope = torch.func.jvp(law.stress, (H,), (direction,))[1]
    assert_close(torch.einsum("...iJkL,...kL->...iJ", law.tangent(H), direction), slope)
    rest = torch.func.jvp(law.stress, (0 * H,), (direction,))[1]
    assert_close(law.rest_stress(direction), rest)
    j = H[..., 0, 0]
    assert_close(law.pressure(j), torch.func.grad(lambda x: law.volumetric_energy(x).sum())(j))


def test_prestretch_follows_a_deformation_of_the_mesh():
    """W(F) of G is W(F K^-1) det K of K G: a mesh that moves by K has the same energy."""
    random = torch.Generator().manual_seed(1)
    G, K, F = torch.eye(3) + 0.2 * torch.rand(3, 3, 3, generator=random, dtype=torch.float64)
    one, other = (fem.Prestretched(LAW, part[None]) for part in (G, K @ G))
    moved = other.energy(F @ torch.linalg.inv(K) - torch.eye(3)) * torch.linalg.det(K)
    assert_close(one.energy(F - torch.eye(3)), moved)


@pytest.mark.parametrize(
    ("law", "stretch", "words"),
    [
        (fem.LinearElastic(0.3), [1.1, 1, 1], "law = LinearElastic"),
        (fem.NeoHookeanLn((0.1, 0.3)), [1.1, 1, 1], "law = NeoHookeanLn"),
        (LAW, [1.1, 1], "stretch of shape"),
        (LAW, [-1.1, 1, 1], "stretch of shape"),
        (LAW, "G", "stretch must be the name of cell data"),
        (LAW, torch.eye(3).expand(7, 3, 3), "stretch of shape .* must have the values of 2 cells"),
    ],
)
def test_invalid_prestretch_is_refused(law, stretch, words):
    with pytest.raises(ValueError, match=words):
        fem.Problem.build(fem.box([2.0, 1.0, 1.0], [3, 2, 2]), fem.Prestretched(law, stretch))


# ------------------------------------------------------------------ closed forms


@pytest.mark.parametrize("name", BODIES)
def test_free_growth_changes_the_shape_without_stress(name):
    mesh = BODIES[name]
    dim = mesh.dim()
    corners = near(mesh, *np.vstack([np.zeros(dim), np.diag(np.ptp(mesh.p, axis=1))])[:dim])
    fixed = np.zeros((mesh.p.shape[1], dim), dtype=bool)
    for k, node in enumerate(corners):  # statically determinate
        fixed[node, k:] = True
    growth = np.array([*GROWTH[:dim], *[1.0] * (3 - dim)])
    problem = fem.Problem.build(mesh, LAW, fixed=fixed)
    grown, stretch = fem.relaxed(problem, 1 / growth)
    assert_close(grown.p.T, mesh.p.T * growth[:dim], rtol=0, atol=1e-12)
    assert_close(stretch, torch.eye(3, dtype=torch.float64).expand_as(stretch), rtol=0, atol=1e-12)


def test_a_bar_that_is_held_stretched_has_the_stress_of_its_stretch():
    mesh = fem.box([1.0, 0.3, 0.3], [4, 3, 3])
    fixed = np.zeros((mesh.p.shape[1], 3), dtype=bool)
    fixed[(mesh.p[0] < 1e-9) | (mesh.p[0] > 1 - 1e-9), 0] = True
    fixed[near(mesh, [0, 0, 0], [0, 0.3, 0])] = [[True, True, True], [True, False, True]]
    problem = fem.Problem.build(mesh, LAW, fixed=fixed)
    mesh, stretch = fem.relaxed(problem, [1.2, 1.0, 1.0])
    bar = fem.Problem.build(mesh, fem.Prestretched(LAW, stretch), fixed=fixed)
    found = bar.stress(torch.zeros(1, *bar.shape, dtype=torch.float64))

    def nominal(across: float) -> Tensor:
        return LAW.stress(
            torch.diag(torch.tensor([0.2, across - 1, across - 1], dtype=torch.float64))
        )

    across = brentq(lambda x: float(nominal(x)[1, 1]), 0.8, 1.1, xtol=1e-14)
    wanted = torch.zeros(3, 3, dtype=torch.float64)
    wanted[0, 0] = nominal(across)[0, 0] / across**2
    assert_close(found, wanted.expand_as(found), rtol=0, atol=1e-10)


def test_a_strip_of_which_one_half_grows_bends_as_a_bimetal():
    """Timoshenko (1925), J. Opt. Soc. Am. 11: curvature 3/2 eps/h of two equal layers."""
    strip = skfem.MeshQuad2.from_mesh(fem.rectangle([1.0, 0.05], [21, 3]))
    eps = 1e-4

    def upper(points: np.ndarray) -> np.ndarray:
        G = np.tile(np.eye(3), (len(points), 1, 1))
        G[points[:, 1] > 0.025, 0, 0] = 1 / (1 + eps)
        return G

    mesh, _ = fem.relaxed(fem.Problem.build(strip, LAW, fixed=fem.Plane(0, "min")), upper)
    (tip,) = near(strip, [1.0, 0.025])
    assert mesh.p[1, tip] - 0.025 == pytest.approx(-0.75 * eps / 0.05, rel=0.03)


# ------------------------------------------------------------------ the stressed body


def test_the_stressed_body_is_in_equilibrium_at_rest(beam):
    stressed, _ = beam
    zero = torch.zeros(1, *stressed.shape, dtype=torch.float64)
    assert stressed.stress(zero).abs().max() > 5e-3
    assert stressed.acting(stressed.evaluate(zero).internal).norm() < 1e-15


def test_small_loads_have_the_linear_solution(beam):
    """K(0) has the residual stress: without it the difference is 100 times as large at least."""
    stressed, plain = (fem.LinearSolver(body) for body in beam)
    load = loads_on(beam[0], 1e-9)
    found = fem.solve(fem.Newton(beam[0], tol=1e-6), load).displacement[0]
    error, without = ((one.solve(load.force[0]) - found).norm() for one in (stressed, plain))
    assert error < 1e-4 * found.norm()
    assert error < 1e-2 * without


def test_loads_of_any_size_converge(beam):
    """Where the residual stress leaves rounding errors, these decide."""
    stressed, _ = beam
    for size in (1e-6, 1e-9, 1e-11):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = fem.solve(fem.Newton(stressed), loads_on(stressed, size))
        assert found.stable
        assert found.iterations <= 5


def test_newton_takes_as_few_iterations_as_without_residual_stress(beam):
    found = [fem.solve(fem.Newton(body), loads_on(body, 2e-3)) for body in beam]
    assert all(bool(solution.stable) for solution in found)
    assert found[0].displacement.norm(dim=-1).max() > 0.2
    assert found[0].iterations <= found[1].iterations + 1


def test_prestretch_breaks_symmetries_of_the_mesh():
    block = fem.box([1.0, 1.0, 1.0], [3, 3, 3])
    bodies = (
        fem.Problem.build(block, law, fixed=fem.Plane(0, "min"))
        for law in (LAW, fem.Prestretched(LAW, [1.0, 1.1, 1.0]))
    )
    assert [len(fem.symmetries(body)) for body in bodies] == [8, 4]


def test_regions_may_be_prestretched_alone():
    law, mesh = fem.Prestretched(LAW, [1.1, 1.0, 1.0]), fem.box([1.0, 0.2, 0.2], [5, 3, 3])
    half, fixed = fem.Box([0.0, 0.0, 0.0], [0.5, 1.0, 1.0]), fem.Plane(0, "min")
    both = {"half": law, "other": fem.YeohK2(0.1, 0.05, 0.01, poisson=0.3)}
    body = fem.Problem.build(mesh, both, regions={"half": half}, fixed=fixed)
    stress = body.stress(torch.zeros(1, *body.shape, dtype=torch.float64))[0]
    left = torch.from_numpy(mesh.p[0, mesh.t].mean(axis=0) < 0.5)
    wanted = law.stress(torch.zeros(3, 3, dtype=torch.float64))
    assert_close(stress[left], wanted.expand_as(stress[left]))
    assert not stress[~left].any()


def test_a_file_has_mesh_and_prestretch(beam, tmp_path):
    stressed, _ = beam
    file = tmp_path / "body.vtu"
    stretch = stressed.material.field
    write_mesh_exactly(file, stressed.mesh_in_metres, {"G": stretch.flatten(1).numpy()})
    law = fem.Prestretched(LAW, "G", file)
    again = fem.Problem.build(fem.read_mesh(file), law, fixed=~stressed.free.numpy())
    assert torch.equal(again.material.field, stretch)
    assert again.material.identity() == stressed.material.identity()


def test_a_scene_refuses_residual_stress_that_is_not_in_equilibrium():
    law = fem.Prestretched(LAW, bent)
    problem = fem.Problem.build(fem.box([1.0, 0.2, 0.2], [5, 3, 3]), law, fixed=fem.Plane(0, "min"))
    newton = fem.Newton(problem)
    with pytest.raises(ValueError, match="residual stress has nodal forces"):
        Scene(problem, fem.ModalLoads(newton.linear_solver), newton)

"""Stress fields of states whose stress is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import skfem
import torch

from dpl.fem import NeoHookeanLn, Plane, Problem, SaintVenantKirchhoff, box, fields, rectangle
from dpl.fem.postprocess import cauchy

LAME, SHEAR = 0.3 / (1.3 * 0.4), 1 / 2.6  # of nu = 0.3, over E


def body(cell: str, degree: int) -> Problem:
    """Return a bar in 3D or a strip in 2D, L = 3."""
    if cell in ("triangle", "quad"):
        mesh = rectangle([3.0, 1.0], [5, 3], cell)
    else:
        mesh = box([3.0, 1.0, 1.0], [4, 3, 3], cell)
    return Problem.build(mesh, NeoHookeanLn(0.3), fixed=Plane(0, "min"), degree=degree)


def affine(problem: Problem, F: np.ndarray) -> torch.Tensor:
    """Return the displacement (1, N, D) of a deformation gradient (D, D)."""
    return (problem.points @ torch.from_numpy(F - np.eye(len(F))).T)[None]


CELLS = [("triangle", 1), ("quad", 2), ("tetra", 1), ("tetra", 2), ("hexahedron", 1)]


@pytest.mark.parametrize(("cell", "degree"), CELLS)
def test_a_uniform_stretch_has_the_cauchy_stress_of_its_law_at_every_node(cell, degree):
    """Neo-Hooke by its closed form: sigma = (mu (b - I) + lambda ln J I) / J (Bonet, Wood)."""
    problem = body(cell, degree)
    dim = problem.shape[1]
    F = np.eye(3)
    F[:dim, :dim] += np.array([[0.3, 0.1, 0.0], [-0.05, -0.1, 0.02], [0.0, 0.04, 0.15]])[:dim, :dim]
    J, b = np.linalg.det(F), F @ F.T
    expected = (SHEAR * (b - np.eye(3)) + LAME * math.log(J) * np.eye(3)) / J
    s = expected - np.trace(expected) / 3 * np.eye(3)
    found = fields(problem, affine(problem, F[:dim, :dim]))
    assert found.stress.shape == (1, len(problem.points), 3, 3)
    assert np.abs(found.stress.numpy() - expected).max() < 1e-13
    assert np.abs(found.von_mises.numpy() - math.sqrt(1.5 * (s * s).sum())).max() < 1e-13
    assert np.abs(found.pressure.numpy() + np.trace(expected) / 3).max() < 1e-13
    assert np.abs(found.volume_ratio.numpy() - J).max() < 1e-13


def irregular(cell: str, degree: int) -> Problem:
    """Return a body with inner nodes off their regular places, and curved cells of degree 2."""
    if cell in ("triangle", "quad"):
        mesh, quadratic = rectangle([3.0, 1.0], [7, 5], cell), (skfem.MeshTri2, skfem.MeshQuad2)
    else:
        mesh, quadratic = box([3.0, 1.0, 1.0], [5, 5, 5], cell), (skfem.MeshTet2, skfem.MeshHex2)
    if degree == 2:
        mesh = quadratic[cell in ("quad", "hexahedron")].from_mesh(mesh)
    places = mesh.doflocs
    inner = np.all((places > 1e-9) & (places < places.max(axis=1, keepdims=True) - 1e-9), axis=0)
    places[:, inner] += np.random.default_rng(0).uniform(-0.03, 0.03, (len(places), inner.sum()))
    return Problem.build(mesh, NeoHookeanLn(0.3), fixed=Plane(0, "min"), degree=degree)


def test_linear_fields_are_recovered_exactly(kind):
    """Values at points (degree 2) or means of cells (degree 1) determine a linear function."""
    problem = irregular(*kind)
    slope = torch.arange(1.0, 1.0 + 3 * problem.shape[1], dtype=torch.float64).reshape(3, -1)
    at = torch.from_numpy(np.array(problem.basis.global_coordinates())).permute(1, 2, 0)
    values = torch.stack([at, -2 * at]) @ slope.T - 0.5  # (B, E, Q, 3)
    expected = torch.stack([problem.points, -2 * problem.points]) @ slope.T - 0.5
    assert torch.allclose(problem.recovery(values), expected, atol=1e-11)


def test_constant_fields_are_recovered_on_a_single_cell(kind):
    """One linear simplex does not determine a linear function; its nodes have the mean."""
    cell, degree = kind
    flat = cell in ("triangle", "quad")
    mesh = rectangle([1.0, 1.0], [2, 2], cell) if flat else box([1.0] * 3, [2, 2, 2], cell)
    problem = Problem.build(mesh.restrict([0]), NeoHookeanLn(0.3), degree=degree)
    constant = torch.full((1, 1, problem.dV.shape[1], 3), 2.5, dtype=torch.float64)
    found = problem.recovery(constant)
    assert found.shape == (1, problem.shape[0], 3)
    assert torch.allclose(found, found.new_tensor(2.5), atol=1e-13)


def test_in_one_layer_of_hexahedra_quadrature_points_determine_the_values():
    mesh = box([3.0, 1.0, 1.0], [4, 2, 2])
    problem = Problem.build(mesh, NeoHookeanLn(0.3), fixed=Plane(0, "min"), length=1.0)
    height = torch.from_numpy(np.array(problem.basis.global_coordinates())[2])[None]
    assert torch.allclose(problem.recovery(height)[0], problem.points[:, 2], atol=1e-12)


def test_recovery_does_not_smear_across_a_slit():
    """Two bodies with the same places of nodes in the plane between them."""
    parts = [box([1.0, 1.0, 1.0], [4, 4, 4], "tetra").translated((x, 0, 0)) for x in (0.0, 1.0)]
    mesh = skfem.MeshTet(
        np.hstack([part.p for part in parts]),
        np.hstack([parts[0].t, parts[1].t + parts[0].p.shape[1]]),
    )
    problem = Problem.build(mesh, NeoHookeanLn(0.3), fixed=Plane(0, "min"))
    half = len(problem.cells) // 2
    values = torch.ones(1, 2 * half, 1, dtype=torch.float64)
    values[:, half:] = 7.0
    found = problem.recovery(values)[0]
    nodes = parts[0].p.shape[1]
    assert torch.allclose(found[:nodes], found.new_tensor(1.0), atol=1e-12)
    assert torch.allclose(found[nodes:], found.new_tensor(7.0), atol=1e-12)


def test_bodies_of_other_laws_share_the_recovery():
    problem = body("tetra", 1)
    assert replace(problem, material=SaintVenantKirchhoff(0.2)).recovery is problem.recovery


def test_recovery_has_derivatives():
    problem = body("quad", 1)
    values = torch.rand(2, len(problem.cells), 4, 3, dtype=torch.float64, requires_grad=True)
    with torch.inference_mode():
        problem.recovery(values)  # makes the matrix
    problem.recovery(values).sum().backward()
    matrix = torch.from_numpy(problem.recovery.matrix.sum(axis=0))
    assert torch.allclose(values.grad, matrix.reshape(1, -1, 4, 1).expand_as(values), atol=1e-13)


@pytest.mark.parametrize("cell", ["tetra", "hexahedron"])
def test_bending_stress_at_the_surface_is_closer_to_the_formula_than_the_mean_of_cells(cell):
    """Pure bending by its exact displacement; sigma_xx = k z (Timoshenko, Goodier, section 102)."""
    mesh = box([4.0, 1.0, 1.0], [17, 5, 5], cell)
    problem = Problem.build(mesh, NeoHookeanLn(0.3), fixed=Plane(0, "min"), length=1.0)
    x, y, z = (problem.points - problem.points.new_tensor([0.0, 0.5, 0.5])).T
    nu, bend = 0.3, 1e-6
    u = bend * torch.stack([x * z, -nu * y * z, -(x**2) / 2 - nu * (z**2 - y**2) / 2], dim=1)
    found = fields(problem, u[None])
    assert float(found.von_mises.min()) >= 0.0
    stress = cauchy(problem, u[None])[0, ..., 0, 0].mean(dim=1)  # (E,); equal volumes
    top = torch.nonzero((z > 0.49) & (x > 1) & (x < 3)).flatten()
    around = [(problem.cells == node).any(dim=1) for node in top]
    means = torch.stack([stress[cells].mean() for cells in around])
    formula = bend * z[top]
    error = (found.stress[0, top, 0, 0] - formula).square().mean().sqrt() / formula[0]
    assert (means - formula).square().mean().sqrt() / formula[0] > 0.15
    assert error < (0.1 if cell == "tetra" else 1e-4)


def test_batches_are_their_members(scene, batch):
    both = fields(scene.problem, batch.displacement[:2])
    one = fields(scene.problem, batch.displacement[1:2])
    for whole, single in zip(both, one, strict=True):
        assert torch.allclose(whole[1:], single, rtol=1e-12, atol=1e-15)


def test_cauchy_stress_is_symmetric_on_solved_states(scene, batch):
    stress = cauchy(scene.problem, batch.displacement)
    assert float((stress - stress.mT).abs().max()) < 1e-12 * float(stress.abs().max())

"""Stress fields of states whose stress is known."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from dpl.fem import NeoHookeanLn, Plane, Problem, box, fields, rectangle
from dpl.fem.postprocess import at_nodes, cauchy, von_mises

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
    assert np.abs(found.volume_ratio.numpy() - J).max() < 1e-13


def test_in_uniaxial_tension_von_mises_is_the_force_per_deformed_area():
    problem = body("hexahedron", 1)
    stretch = 1.4

    def side(t: float) -> float:
        return SHEAR * (t * t - 1) + LAME * math.log(stretch * t * t)

    t = brentq(side, 0.5, 1.0, xtol=1e-15)
    pull = (SHEAR * (stretch**2 - 1) + LAME * math.log(stretch * t * t)) / (stretch * t * t)
    found = fields(problem, affine(problem, np.diag([stretch, t, t])))
    assert torch.allclose(found.von_mises, torch.tensor(pull, dtype=torch.float64), atol=1e-13)


def test_pressure_has_no_von_mises_stress_and_rotations_none_at_all():
    problem = body("hexahedron", 1)
    assert fields(problem, affine(problem, 1.2 * np.eye(3))).von_mises.max() < 1e-13
    c, s = math.cos(0.7), math.sin(0.7)
    turned = fields(problem, affine(problem, np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])))
    assert turned.stress.abs().max() < 1e-13


def test_nodal_values_are_volume_weighted_means_of_the_adjacent_cells():
    """Two cells of lengths 1 and 2: what they share lies two thirds of the way to the longer."""
    mesh = box([3.0, 1.0, 1.0], [3, 2, 2])
    mesh.p[0, mesh.p[0] == 1.5] = 1.0
    problem = Problem.build(mesh, NeoHookeanLn(0.3), fixed=Plane(0, "min"), length=1.0)
    ends = problem.points[problem.cells][..., 0]
    value = ends.mean(dim=1)[None, :, None].expand(1, -1, problem.dV.shape[1])
    at_one = at_nodes(problem, value)[0][problem.points[:, 0] == 1.0]
    assert torch.allclose(at_one, torch.tensor((0.5 + 2 * 2.0) / 3, dtype=torch.float64))


def test_batches_are_their_members(scene, batch):
    both = fields(scene.problem, batch.displacement[:2])
    one = fields(scene.problem, batch.displacement[1:2])
    for whole, single in zip(both, one, strict=True):
        assert torch.allclose(whole[1:], single, rtol=1e-12, atol=1e-15)


def test_von_mises_of_shear_is_root_three_of_it():
    stress = torch.zeros(3, 3, dtype=torch.float64)
    stress[0, 1] = stress[1, 0] = 2.0
    assert float(von_mises(stress)) == pytest.approx(2 * math.sqrt(3))


def test_cauchy_stress_is_symmetric_on_solved_states(scene, batch):
    stress = cauchy(scene.problem, batch.displacement)
    assert float((stress - stress.mT).abs().max()) < 1e-12 * float(stress.abs().max())

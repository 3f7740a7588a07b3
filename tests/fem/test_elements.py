"""Isoparametric elements: curved cells are integrated as exactly as straight ones."""

import math

import numpy as np
import pytest
import skfem
import torch

from dpl.fem import LinearElastic, Material, NeoHookeanLn, Problem, box, rectangle
from dpl.fem.assembly.elements import CURVED, basis_of
from dpl.fem.mesh import check_mesh

H = np.array([[0.02, 0.05, -0.01], [0.03, -0.04, 0.02], [-0.02, 0.01, 0.03]])
ISOPARAMETRIC = {
    "tri6": (rectangle, "triangle", skfem.MeshTri2),
    "quad9": (rectangle, "quad", skfem.MeshQuad2),
    "tet10": (box, "tetra", skfem.MeshTet2),
    "hex27": (box, "hexahedron", skfem.MeshHex2),
}


def moved(element: str, size: float = 0.04) -> skfem.Mesh:
    """Return a unit body of two cells a side whose nodes, also those of edges, are all moved."""
    grid, cell, kind = ISOPARAMETRIC[element]
    dim = 2 if grid is rectangle else 3
    mesh = kind.from_mesh(grid([1.0] * dim, [3] * dim, cell))
    shift = np.random.default_rng(3).uniform(-size, size, mesh.doflocs.shape)
    return kind(mesh.doflocs + shift, mesh.t)


@pytest.mark.parametrize("law", [LinearElastic(0.3), NeoHookeanLn(0.3)], ids=["linear", "NH-ln"])
@pytest.mark.parametrize("element", ISOPARAMETRIC)
def test_curved_elements_pass_the_patch_test(element, law):
    check_patch(check_mesh(moved(element)), law)


def test_elements_a_million_lengths_away_pass_the_patch_test(kind, grid):
    """The geometry is that of the rounded coordinates."""
    mesh = grid(kind[0], 3, 0.15)
    mesh = mesh.translated(1e6 * np.array([1.0, -0.7, 0.9])[: mesh.dim()])
    check_patch(check_mesh(mesh), NeoHookeanLn(0.3), degree=kind[1])


def check_patch(mesh: skfem.Mesh, law: Material, **options) -> None:
    """Assert that a homogeneous strain is in balance at every inner node, up to rounding."""
    problem = Problem.build(mesh, law, length=1.0, **options)
    strain = torch.from_numpy(H[: mesh.dim(), : mesh.dim()])
    field = (problem.points @ strain.T)[None]
    force = problem.internal_force(field)[0]
    assert not problem.boundary.all()
    assert force[~problem.boundary].norm() < problem.roundoff_bound(field)
    assert force[problem.boundary].norm() > 1e6 * problem.roundoff_bound(field)


@pytest.mark.parametrize("element", ISOPARAMETRIC)
def test_the_volume_of_curved_elements_is_that_of_finer_quadrature(element):
    mesh = moved(element)
    fine = skfem.Basis(mesh, mesh.elem(), intorder=9).dx.sum(axis=1)
    problem = Problem.build(mesh, LinearElastic(0.3), length=1.0)
    assert problem.dV.sum(dim=1).numpy() == pytest.approx(fine, rel=1e-13)


def test_the_rule_for_curved_tetrahedra_is_positive_and_of_degree_3():
    X, W = basis_of(moved("tet10"), 2).quadrature
    assert X.shape == (3, 4 * len(CURVED))
    assert (W > 0).all()
    assert ((X > 0).all(axis=0) & (X.sum(axis=0) < 1)).all()
    for powers in np.ndindex(4, 4, 4):
        if sum(powers) <= 3:
            exact = math.prod(map(math.factorial, powers)) / math.factorial(sum(powers) + 3)
            found = W @ np.prod(X ** np.array(powers)[:, None], axis=0)
            assert found == pytest.approx(exact, rel=1e-14)


def test_straight_tetrahedra_of_ten_nodes_keep_four_points():
    """Whether the file or `degree` gave them their nodes, and wherever rounding put these."""
    straight = box([1.0] * 3, [3] * 3, "tetra")
    assert basis_of(straight, 2).dx.shape[1] == 4
    assert basis_of(skfem.MeshTet2.from_mesh(straight), 2).dx.shape[1] == 4
    assert basis_of(moved("tet10", 1e-12), 2).dx.shape[1] == 4
    assert basis_of(moved("tet10", 1e-4), 2).dx.shape[1] == 8

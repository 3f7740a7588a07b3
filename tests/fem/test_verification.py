"""Patch tests and orders of accuracy: answers against theory and other codes."""

import math
from functools import cache

import numpy as np
import pytest
import skfem
import torch
from solving import load_of, without_load
from torch.testing import assert_close

from benchmarks.verification.refinement import ERRORS, errors
from dpl import fem
from dpl.fem.loads import traction

SVK, NH = fem.SaintVenantKirchhoff(0.25), fem.NeoHookeanLn(0.25)

# Patch test, MacNeal and Harder (1985): a cube in a cube
OUTER = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
INNER = [
    *([0.249, 0.342, 0.192], [0.826, 0.288, 0.288], [0.850, 0.649, 0.263], [0.273, 0.750, 0.230]),
    *([0.320, 0.186, 0.643], [0.677, 0.305, 0.683], [0.788, 0.693, 0.644], [0.165, 0.745, 0.702]),
]
FACES = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
VOLUMES = [
    *(0.0985582675, 0.1369742575, 0.1894968033, 0.1527662996),
    *(0.1701827558, 0.1418706427, 0.1101509738),
]
LOCAL = [0, 4, 3, 1, 7, 5, 2, 6]  # scikit-fem's order of the corners OUTER
# P at a general F, independent code, and of the patch test
GENERAL = [[0.2, 0.2, -0.1], [0.05, -0.05, 0.15], [-0.08, 0.12, 0.1]]
SMALL = [[1e-3, 5e-4, 5e-4], [5e-4, 1e-3, 5e-4], [5e-4, 5e-4, 1e-3]]


def cube_in_cube() -> skfem.MeshHex:
    """Return the patch of seven hexahedra: the inner one and one on each of its faces."""
    cells = [[8 + k for k in range(8)]] + [[*face, *(8 + k for k in face)] for face in FACES]
    points = np.array(OUTER + INNER, dtype=float)
    return skfem.MeshHex(points.T.copy(), np.array(cells)[:, LOCAL].T.copy())


def stretched(
    mesh: skfem.Mesh, law: fem.Material, H: list[list[float]], degree: int
) -> fem.Problem:
    """Return the body whose boundary nodes are moved by H X."""
    bare = fem.Problem.build(mesh, law, degree=degree, length=1.0)
    given = bare.points.numpy() @ np.array(H).T
    return fem.Problem.build(
        mesh, law, fixed=bare.boundary.numpy(), prescribed=given, degree=degree, length=1.0
    )


def test_patch_of_macneal_and_harder_has_the_printed_volumes():
    """Patch test, MacNeal and Harder (1985)."""
    problem = fem.Problem.build(cube_in_cube(), NH, length=1.0)
    volumes = problem.dV.sum(dim=1).numpy()
    assert np.sort(volumes) == pytest.approx(np.sort(VOLUMES), abs=1e-10)
    assert volumes.sum() == pytest.approx(1.0, rel=1e-14)
    assert problem.boundary.sum() == 8


@pytest.mark.parametrize(
    ("law", "degree", "normal", "shear", "tolerance"),
    [
        *((fem.LinearElastic(0.25), degree, 2000.0, 400.0, 1e-11) for degree in (1, 2)),
        (NH, 1, 1997.3048905, 398.9029931, 1e-10),
        (SVK, 1, 2003.902, 402.1015, 5e-7),
        (fem.NeoHookeanIsoK4(0.25), 1, 2002.1046292, 398.1021937, 1e-10),
    ],
    ids=["linear", "linear, quadratic cells", "NH-ln", "SVK", "NHiso-k4"],
)
def test_patch_has_the_printed_stress(law, degree, normal, shear, tolerance):
    """MacNeal and Harder (1985), E = 1e6: 2000 and 400 in one iteration; and in finite strain."""
    problem = stretched(cube_in_cube(), law, SMALL, degree)
    answer = without_load(problem, tol=1e-12, linear="superlu")
    assert answer.converged.all()
    if not law.finite:
        assert answer.iterations.item() == 1
        H = torch.tensor(SMALL, dtype=torch.float64)
        assert (answer.displacement[0] - problem.points @ H.T).abs().max() < 1e-15
    stress = 1e6 * problem.stress(answer.displacement)
    expected = shear + (normal - shear) * torch.eye(3, dtype=torch.float64)
    assert_close(stress, expected.expand_as(stress), rtol=tolerance, atol=0.0)


def test_crooked_patch_of_any_element_passes(kind, grid):
    """Patch test with randomly moved inner nodes."""
    (cell, degree), law = kind, SVK if kind in (("quad", 1), ("tetra", 2)) else NH
    mesh = grid(cell, 3, 0.2, inside=True)
    dim = mesh.dim()
    problem = stretched(mesh, law, [row[:dim] for row in GENERAL[:dim]], degree)
    assert not problem.discretisation.equal_cells
    check_patch(problem, without_load(problem, tol=1e-12, linear="superlu"))


def check_patch(problem: fem.Problem, answer: fem.Solution) -> None:
    """Assert that the displacement is H X, the stress uniform and of few iterations."""
    dim = problem.shape[1]
    H = torch.zeros(3, 3, dtype=torch.float64)
    H[:dim, :dim] = torch.tensor(GENERAL, dtype=torch.float64)[:dim, :dim]
    assert answer.converged.all()
    assert answer.load_factor.item() == 1
    assert answer.iterations.item() <= 8
    exact = problem.points @ H[:dim, :dim].T
    assert problem.free.any()
    assert (answer.displacement[0] - exact).abs().max() < 1e-13
    stress = problem.stress(answer.displacement)
    assert_close(stress, problem.material.stress(H).expand_as(stress), rtol=0.0, atol=1e-11)


@pytest.mark.parametrize(
    ("law", "cell", "degree"),
    [(NH, "tetra", 1), (SVK, "tetra", 2), (SVK, "hexahedron", 1), (NH, "hexahedron", 2)],
)
def test_crooked_patch_passes_under_tractions(law, cell, degree, grid):
    """Patch test with tractions: confined stretch 1.4 by P11 on x = 1; the other sides slide."""
    mesh = grid(cell, 2, 0.2, inside=True)
    bare = fem.Problem.build(mesh, law, degree=degree, length=1.0)
    held = bare.points.numpy() < 1e-9
    held[:, 1:] |= bare.points[:, 1:].numpy() > 1 - 1e-9
    problem = fem.Problem.build(mesh, law, fixed=held, degree=degree, length=1.0)
    stretch = torch.diag(torch.tensor([0.4, 0, 0], dtype=torch.float64))
    P11 = law.stress(stretch)[0, 0].item()
    force = traction(
        problem, fem.Plane(0, "max"), lambda x: np.stack([0 * x[0] + P11, 0 * x[1], 0 * x[2]])
    )
    answer = fem.solve(fem.Newton(problem, tol=1e-12, linear="superlu"), load_of(force[None]))
    assert answer.converged.all()
    assert (answer.displacement[0] - problem.points @ stretch).abs().max() < 1e-11


@cache
def measured(cell: str, degree: int, level: int) -> tuple[float, float]:
    """Return the errors of NH-ln on a mesh of the table in L2 and the H1-seminorm."""
    return errors(cell, degree, ERRORS[cell, degree][0][level])


@pytest.mark.parametrize("level", [1, 2])
@pytest.mark.parametrize(("cell", "degree"), ERRORS)
def test_manufactured_answer_has_the_printed_error(cell, degree, level):
    """Errors of the manufactured solution; tetrahedra (another diagonal) within 10 %."""
    found = measured(cell, degree, level)
    for error, printed in zip(found, ERRORS[cell, degree][1:], strict=True):
        known = dict(zip((3, 2, 1, 0), map(float, reversed(printed.split())), strict=False))
        tolerance = 5e-3 if cell == "hexahedron" else 0.1
        assert level not in known or error == pytest.approx(known[level], rel=tolerance)


@pytest.mark.parametrize(("cell", "degree"), ERRORS)
def test_error_falls_with_the_order_of_the_element(cell, degree):
    """Orders above p + 1 - 0.2 in L2 and p - 0.1 in H1."""
    coarse, fine = (measured(cell, degree, level) for level in (1, 2))
    assert math.log2(coarse[0] / fine[0]) > degree + 1 - 0.2
    assert math.log2(coarse[1] / fine[1]) > degree - 0.1


@pytest.mark.slow
def test_error_of_mean_dilatation_falls_with_the_order_of_its_element():
    """Elements with mean dilatation are as accurate where no element locks."""
    coarse, fine = (errors("hexahedron", 1, n, mean_dilatation=True) for n in (4, 8))
    assert math.log2(coarse[0] / fine[0]) > 1.8
    assert math.log2(coarse[1] / fine[1]) > 0.95
    assert fine == pytest.approx(errors("hexahedron", 1, 8), rel=0.25)

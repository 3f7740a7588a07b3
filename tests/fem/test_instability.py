"""Limit points and bifurcations: a column, a Yeoh cube, the cube of Rivlin.

Solutions about these points are cases T17 and T22 of `benchmarks.stress`.
"""

import numpy as np
import pytest
import torch
from solving import inertia
from torch import Tensor

from benchmarks.stress.fixtures import (
    RUBBER,
    as_load,
    column,
    cube,
    equitriaxial_stretch,
    uniaxial_stretch,
)
from dpl import fem

# a cell that is uniformly strained does not lock
pytestmark = [
    pytest.mark.filterwarnings("ignore:linear .* lock"),
    pytest.mark.filterwarnings("ignore:.*rounding allows no less"),  # moduli of 1 and 1e6
]

SVK, NH = fem.SaintVenantKirchhoff(0.0), fem.NeoHookeanLn(0.0)


def squeezed(problem: fem.Problem, force: Tensor, P: float) -> fem.Solution:
    """Return the answer to an axial load."""
    return fem.solve(fem.Newton(problem, tol=1e-10, linear="superlu"), as_load(P * force))


# Column of 10 x 1 x 1 m: law, cells, P at which K is singular; Euler's load is 2.056168
CRITICAL = [
    (SVK, (10, 1, 1), 2.039763),
    pytest.param(SVK, (20, 2, 2), 2.037811, marks=pytest.mark.slow),
    (NH, (10, 1, 1), 2.056558),
]


@pytest.mark.parametrize(("law", "cells", "printed"), CRITICAL)
def test_column_loses_its_stability_at_the_critical_load(law, cells, printed):
    """Column of 10 x 1 x 1 m: inertia of the tangent of the straight state."""
    problem, force = column(law, cells)
    for P, negative in ((printed - 5.1e-7, 0), (printed + 5.1e-7, 2)):
        answer = squeezed(problem, force, P)
        assert answer.converged.all()
        assert inertia(problem, answer.displacement) == negative
    for part, status, negative in (
        (0.9999, fem.Status.CONVERGED, 0),
        (1.0001, fem.Status.UNSTABLE, 2),
    ):
        answer = squeezed(problem, force, part * printed)
        assert answer.status.item() == status
        assert answer.negative_pivots.item() == negative


@pytest.mark.parametrize("off", [0.0, -0.01, 0.01])
@pytest.mark.parametrize(
    ("stretch", "printed", "sign"),
    [(1.364017197, 0.5696673896, -1), (2.398502327, -1.461699953, 1)],
    ids=["peak", "trough"],
)
def test_pull_on_yeohs_rubber_has_the_tabulated_extremes(stretch, printed, sign, off):
    """Yeoh cube (felupe ex09) under prescribed stretch: force maximum and minimum.

    The bulk modulus leaves 3e-6 of it.
    """
    mesh = fem.box([1.0, 1.0, 1.0], [2, 2, 2])  # one cell, which slides on three planes
    held, given = mesh.p.T == 0, np.zeros((8, 3))
    held[:, 0], given[:, 0] = True, (stretch + off - 1) * mesh.p[0]
    problem = fem.Problem.build(mesh, RUBBER, fixed=held, prescribed=given, length=1.0)
    none = torch.zeros(problem.shape, dtype=torch.float64)
    solver = fem.Newton(problem, tol=1e-11, linear="superlu")
    *_, answer = solver.iterate(as_load(none), guess=uniaxial_stretch(problem, stretch + off))
    assert answer.converged.all()
    far = problem.points[:, 0] == 1
    pull = problem.internal_force(answer.displacement)[0, far, 0].sum().item()
    if off:
        assert sign * (pull - printed) > 1e-5
    else:
        assert pull == pytest.approx(printed, rel=5e-6)


def rivlin(poisson: float) -> fem.Problem:
    """Return a cube of one cell that slides on three planes."""
    return cube(fem.NeoHookeanLn(poisson), 1, (0, 1, 2))[0]


@pytest.mark.parametrize(
    ("poisson", "stretch", "load"),
    [(0.45, 1.083880948, 0.7475041023), (0.49, 1.013891353, 0.6804639956)],
)
def test_cube_of_rivlin_loses_its_symmetry_at_the_tabulated_load(poisson, stretch, load):
    """Cube of Rivlin (1948), NH-ln: the inertia changes by two."""
    problem = rivlin(poisson)
    assert inertia(problem, equitriaxial_stretch(problem, stretch - 1.5e-9)[0]) == 0
    assert inertia(problem, equitriaxial_stretch(problem, stretch + 1.5e-9)[0]) == 2
    assert equitriaxial_stretch(problem, stretch)[1] == pytest.approx(load, abs=1e-7)


def test_compressible_cube_of_rivlin_keeps_its_symmetry():
    """Cube of Rivlin (1948): NH-ln with nu = .3 has no such load."""
    problem = rivlin(0.3)
    for stretch in np.linspace(1.0, 4.0, 16):
        assert inertia(problem, equitriaxial_stretch(problem, stretch)[0]) == 0


def test_cube_of_rivlin_loses_its_symmetry_at_two_shear_moduli_in_the_limit():
    """Cube of Rivlin (1948): T / mu = 2 for incompressible bodies."""
    excess = []
    for poisson in (0.499, 0.4999):
        problem, critical, step = rivlin(poisson), 1.0, 0.05
        while step > 1e-9:  # bisection
            is_stable = not inertia(problem, equitriaxial_stretch(problem, critical + step)[0])
            critical, step = critical + step * is_stable, step / 2
        excess.append(equitriaxial_stretch(problem, critical)[1] / float(problem.material.mu) - 2)
    assert excess[1] == pytest.approx(0, abs=1e-3)
    assert excess[0] / excess[1] == pytest.approx(10, rel=0.05)

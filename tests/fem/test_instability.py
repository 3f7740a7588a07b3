"""Limit points and bifurcations: a column, a Yeoh cube, the cube of Rivlin, limits of laws."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.stress.fixtures import (
    RUBBER,
    as_load,
    bent_column,
    column,
    cube,
    equitriaxial_stretch,
    uniaxial_stretch,
)
from dpl import fem
from dpl.fem.linear import SuperLU

# a cell that is uniformly strained does not lock
pytestmark = [
    pytest.mark.filterwarnings("ignore:linear .* lock"),
    pytest.mark.filterwarnings("ignore:.*rounding allows no less"),  # moduli of 1 and 1e6
]

SVK, NH = fem.SaintVenantKirchhoff(0.0), fem.NeoHookeanLn(0.0)
EYE = torch.eye(3, dtype=torch.float64)


def inertia(problem: fem.Problem, displacement: Tensor) -> int:
    """Return the number of negative eigenvalues of K at a displacement (1, N, D)."""
    tangent = problem.linearise(displacement).tangent[0].numpy()
    return SuperLU(problem.pattern).factorise(tangent).negative_pivots


def loses_symmetry(problem, stretch: float) -> bool:
    """Return True if an equitriaxially stretched cube is unstable."""
    return inertia(problem, equitriaxial_stretch(problem, stretch)[0]) > 0


def bisected(loses, stable: float, unstable: float) -> float:
    """Return where a truth value changes from false at `stable` to true at `unstable`."""
    assert not loses(stable)
    assert loses(unstable)
    while abs(unstable - stable) > 1e-9:
        middle = (stable + unstable) / 2
        stable, unstable = (stable, middle) if loses(middle) else (middle, unstable)
    return (stable + unstable) / 2


def squeezed(problem: fem.Problem, force: Tensor, P: float, **options) -> fem.Solution:
    """Return the answer to an axial load, from rest or from a guess."""
    guess = options.pop("guess", None)
    solver = fem.Newton(problem, tol=1e-10, linear="superlu", **options)
    *_, last = solver.iterate(as_load(P * force), guess=guess)
    return last


# Column of 10 x 1 x 1 m: law, cells, P at which K is singular; Euler's load is 2.056168
CRITICAL = [
    (SVK, (10, 1, 1), 2.039763),
    pytest.param(SVK, (20, 2, 2), 2.037811, marks=pytest.mark.slow),
    (NH, (10, 1, 1), 2.056558),
]


@pytest.mark.parametrize(("law", "cells", "printed"), CRITICAL)
def test_column_loses_its_stability_at_the_critical_load(law, cells, printed):
    """Column of 10 x 1 x 1 m: bisection on the inertia of the tangent of the straight state."""
    problem, force = column(law, cells)

    def buckles(P: float) -> bool:
        answer = squeezed(problem, force, P)
        assert answer.converged.all()
        return inertia(problem, answer.displacement) > 0

    critical = bisected(buckles, 1.9, 2.2)
    assert critical == pytest.approx(printed, abs=5.1e-7)
    for part, status, negative in (
        (0.9999, fem.Status.CONVERGED, 0),
        (1.0001, fem.Status.UNSTABLE, 2),
    ):
        answer = squeezed(problem, force, part * critical)
        assert answer.status.item() == status
        assert answer.negative_pivots.item() == negative


# beyond buckling: P, angle of the guess, w / L and u / L of the centre of the end,
# the same of the elastica
BUCKLED = [(2.5, 1.2, (0.6873, 0.3885), (0.66363, 0.34682))]
BUCKLED += [(4.0, 2.0, (0.7925, 0.9731), (0.80022, 0.90518))]


@pytest.mark.parametrize(
    ("P", "angle", "printed", "elastica", "side", "mixed"),
    [(*BUCKLED[0], 1.0, False), (*BUCKLED[0], -1.0, True), (*BUCKLED[1], 1.0, True)],
)
def test_buckled_column_is_found_from_a_bent_guess(P, angle, printed, elastica, side, mixed):
    """Column of 10 x 1 x 1 m: a stable answer to either side, mirror images of each other."""
    problem, force = column(SVK, (20, 2, 2))
    answer = squeezed(
        problem, force, P, guess=bent_column(problem, angle, side), mixed_integration=mixed
    )
    assert answer.status.item() == fem.Status.CONVERGED
    assert inertia(problem, answer.displacement) == 0
    centre = torch.tensor([1.0, 0.05, 0.05], dtype=torch.float64)
    end = answer.displacement[0, (problem.points - centre).norm(dim=1).argmin()] * side
    assert (end[2].item(), -side * end[0].item()) == pytest.approx(printed, abs=5.1e-5)
    assert end[2].item() == pytest.approx(elastica[0], rel=0.04)  # shear makes it softer
    assert abs(end[1].item()) < 1e-9


def pulled(stretch: float | None = None) -> tuple[fem.Problem, Tensor]:
    """Return a cube of one cell that slides on three planes, and its unit load along x.

    With a stretch its end is moved instead.
    """
    mesh = fem.box([1.0, 1.0, 1.0], [2, 2, 2])
    held, given = mesh.p.T == 0, np.zeros((8, 3))
    if stretch is not None:
        held[:, 0], given[:, 0] = True, (stretch - 1) * mesh.p[0]
    problem = fem.Problem.build(mesh, RUBBER, fixed=held, prescribed=given, length=1.0)
    return problem, fem.Traction(fem.Plane(0, "max"), [1.0, 0.0, 0.0]).on(problem)


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
    problem, _ = pulled(stretch + off)
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


def test_load_beyond_the_peak_is_reported_with_the_part_below_it():
    """Yeoh cube (felupe ex09): load control from rest ends at P = .5696673896."""
    problem, unit = pulled()
    solver = fem.Newton(
        problem,
        linear="superlu",
        intermediate_tol=1e-9,
        min_load_step=2.0**-17,
        max_total_iter=2000,
    )
    answer = fem.solve(solver, as_load(0.57 * unit))
    assert answer.status.item() == fem.Status.NO_VALID_EQUILIBRIUM
    assert 0.57 * answer.load_factor.item() == pytest.approx(0.5696673896, abs=2e-5)
    assert 1 + answer.displacement[..., 0].max().item() == pytest.approx(1.364017197, abs=0.02)


def test_rubber_beyond_the_peak_has_snapped_through():
    """Yeoh cube (felupe ex09): from a guess beyond the gap, P = .57 has the stretch 2.836546."""
    problem, unit = pulled()
    solver = fem.Newton(problem, tol=1e-10, linear="superlu")
    *_, answer = solver.iterate(as_load(0.57 * unit), guess=uniaxial_stretch(problem, 2.8))
    assert answer.status.item() == fem.Status.CONVERGED
    assert answer.load_factor.item() == 1
    stretch = 1 + answer.displacement[..., 0].max().item()
    assert stretch == pytest.approx(2.836546, abs=5e-6)


def rivlin(law: fem.Material) -> tuple[fem.Problem, Tensor]:
    """Return a cube of one cell that slides on three planes, pulled on the others by T = 1."""
    return cube(law, 1, (0, 1, 2))


@pytest.mark.parametrize(
    ("poisson", "stretch", "load"),
    [(0.45, 1.083880948, 0.7475041023), (0.49, 1.013891353, 0.6804639956)],
)
def test_cube_of_rivlin_loses_its_symmetry_at_the_tabulated_load(poisson, stretch, load):
    """Cube of Rivlin (1948), NH-ln: the inertia changes by two; beyond, the answer says so."""
    problem, unit = rivlin(fem.NeoHookeanLn(poisson))
    critical = bisected(partial(loses_symmetry, problem), 1.0, 1.1)
    assert critical == pytest.approx(stretch, abs=1.5e-9)
    assert equitriaxial_stretch(problem, critical)[1] == pytest.approx(load, abs=1e-7)
    assert inertia(problem, equitriaxial_stretch(problem, critical + 1e-6)[0]) == 2
    for part, status, negative in ((0.99, fem.Status.CONVERGED, 0), (1.01, fem.Status.UNSTABLE, 2)):
        state, T = equitriaxial_stretch(problem, 1 + part * (critical - 1))
        answer = fem.solve(fem.Newton(problem, linear="superlu"), as_load(T * unit))
        assert answer.status.item() == status
        assert answer.negative_pivots.item() == negative
        assert (answer.displacement - state).abs().max() < 1e-7


def test_compressible_cube_of_rivlin_keeps_its_symmetry():
    """Cube of Rivlin (1948): NH-ln with nu = .3 has no such load."""
    problem, _ = rivlin(fem.NeoHookeanLn(0.3))
    for stretch in np.linspace(1.0, 4.0, 61):
        assert inertia(problem, equitriaxial_stretch(problem, stretch)[0]) == 0


def test_cube_of_rivlin_loses_its_symmetry_at_two_shear_moduli_in_the_limit():
    """Cube of Rivlin (1948): T / mu = 2 for incompressible bodies."""
    excess = []
    for poisson in (0.499, 0.4999):
        law = fem.NeoHookeanLn(poisson)
        problem, _ = rivlin(law)
        critical = bisected(partial(loses_symmetry, problem), 1.0, 1.1)
        excess.append(equitriaxial_stretch(problem, critical)[1] / float(law.mu) - 2)
    assert excess[1] == pytest.approx(0, abs=1e-3)
    assert excess[0] / excess[1] == pytest.approx(10, rel=0.05)


def bar(law: fem.Material) -> tuple[fem.Problem, Tensor]:
    """Return a cube of 2 x 2 x 2 cells that slides on three planes, and the load P = 1 along x."""
    return cube(law, 2)


@pytest.mark.parametrize(
    ("P", "stretch", "mixed"),
    [
        *((-1, 0.4835138104, True), (-10, 0.1073321638, False), (-10, 0.1073321638, True)),
        *((1, 2.780359487, False), (10, 26.00274671, False), (10, 26.00274671, True)),
    ],
)
def test_neo_hookean_bar_answers_every_load(P, stretch, mixed):
    """NH-ln has a volumetric barrier: any compressive load has a solution from rest."""
    problem, unit = bar(fem.NeoHookeanLn(0.3))
    answer = fem.solve(
        fem.Newton(problem, tol=1e-11, linear="superlu", mixed_integration=mixed), as_load(P * unit)
    )
    assert answer.converged.all()
    found = 1 + answer.displacement[0, problem.points[:, 0] == 1, 0]
    assert found.tolist() == pytest.approx([stretch] * 9, rel=1e-8)


@pytest.mark.parametrize("mixed", [False, True], ids=["plain", "mixed"])
def test_quadratic_volume_term_is_no_barrier_under_pressure(mixed):
    """NHiso-k2 carries kappa s^2 (1 - s^3) at most, s^3 = 2/5; NH-ln carries any pressure."""
    law = fem.NeoHookeanIsoK2(0.3)
    problem, unit = rivlin(law)
    limit = float(law.bulk) * 0.4 ** (2 / 3) * 0.6
    for part, status in ((0.99, fem.Status.CONVERGED), (1.02, fem.Status.NO_VALID_EQUILIBRIUM)):
        solver = fem.Newton(problem, linear="superlu", mixed_integration=mixed)
        answer = fem.solve(solver, as_load(-part * limit * unit))
        assert answer.status.item() == status
        assert answer.volume_ratio.item() > 0
    assert answer.load_factor.item() == pytest.approx(1 / 1.02, abs=0.02)
    problem, unit = rivlin(fem.NeoHookeanLn(0.3))
    answer = fem.solve(
        fem.Newton(problem, linear="superlu", mixed_integration=mixed), as_load(-3 * limit * unit)
    )
    assert answer.converged.all()


def test_mirror_image_of_a_body_at_rest_is_no_answer():
    """SVK is invariant under reflection: a mirrored body has no internal forces."""
    problem, _ = bar(fem.SaintVenantKirchhoff(0.3))
    mirrored = (problem.points * torch.tensor([-2.0, 0.0, 0.0]))[None]
    assert problem.internal_force(mirrored).abs().max() < 1e-15
    verdict = fem.evaluate_solution(
        problem, mirrored, as_load(torch.zeros(problem.shape).double()), 1e-8
    )
    assert verdict.volume_ratio.item() == pytest.approx(-1.0)
    assert verdict.status.item() == fem.Status.NOT_CONVERGED


def test_longest_load_of_a_saint_venant_bar_is_the_tabulated_one():
    """SVK, closed form: max |P| = E / (3 sqrt 3) = .1924500897 at a stretch of .57735."""
    problem, unit = bar(fem.SaintVenantKirchhoff(0.3))
    solver = fem.Newton(
        problem,
        linear="superlu",
        intermediate_tol=1e-9,
        min_load_step=2.0**-17,
        max_total_iter=2000,
    )
    answer = fem.solve(solver, as_load(-0.2 * unit))
    assert answer.status.item() == fem.Status.NO_VALID_EQUILIBRIUM
    assert 0.2 * answer.load_factor.item() == pytest.approx(0.1924500897, abs=1e-5)
    stretch = 1 + answer.displacement[..., 0].min().item()
    assert stretch == pytest.approx(1 / math.sqrt(3), abs=0.01)

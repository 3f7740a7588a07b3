"""Solutions of other codes and of theory: beams, Cook's membrane, torsion, the elastica."""

import math
from collections.abc import Iterator
from decimal import Decimal

import pytest
import torch
from solving import load_of
from torch import Tensor

from benchmarks.verification.bodies import balanced, mean, slender
from benchmarks.verification.refinement import FINER, OTHERS, SIDES, at, membrane
from benchmarks.verification.rods import BENT, KINDS, LOCKED, SAME
from benchmarks.verification.twisted import TWIST, twisted
from dpl import fem

# these benchmarks are about elements that lock
pytestmark = pytest.mark.filterwarnings("ignore:linear .* lock")

SVK, NH, K4 = fem.SaintVenantKirchhoff(0.3), fem.NeoHookeanLn(0.3), fem.NeoHookeanIsoK4(0.3)


def resumed(problem: fem.Problem, force: Tensor, guess: Tensor | None, **options) -> fem.Solution:
    """Return the answer that Newton reaches from a guess."""
    *_, last = fem.Newton(problem, **options).iterate(load_of(force[None]), guess=guess)
    return last


def node_at(problem: fem.Problem, *place: float) -> int:
    """Return the number of the node at a place [m], one coordinate for each of the first axes."""
    given = torch.tensor(place, dtype=torch.float64) / problem.length
    distance = (problem.points[:, : len(place)] - given).norm(dim=1)
    assert distance.min() < 1e-9
    return int(distance.argmin())


# Caribou (mimesis-inria), test_static.cpp: R_k / R_1 of load steps 1 to 5, R_1 after one iteration
CARIBOU = [
    [4.802014100e-3, 3.457785824e-4, 6.4178e-8],
    [4.700052322e-3, 3.771851553e-4, 1.289757639e-5, 2.12504e-8],
    [4.416064536e-3, 4.703733157e-4, 3.659722934e-5, 7.7915e-8],
    [4.003458215e-3, 6.263051714e-4, 4.996976075e-5, 1.42207e-7],
    [3.526942204e-3, 8.307813177e-4, 4.667215114e-5, 1.64673e-7],
]


def caribou(degree: int) -> tuple[fem.Problem, Tensor]:
    """Return the beam 15 x 15 x 80 along z of Caribou's regression test, and its whole load."""
    mesh = fem.box([15.0, 15.0, 80.0], [3, 3, 9])
    law = fem.SaintVenantKirchhoff(0.499)
    problem = fem.Problem.build(mesh, law, fixed=fem.Plane(2, "min"), degree=degree)
    return problem, fem.Traction(fem.Plane(2, "max"), [0.0, -30 / 3000, 0.0]).on(problem)


def load_steps(problem: fem.Problem, force: Tensor) -> Iterator[tuple[list[float], Tensor]]:
    """Yield R_k / R_1 and the last displacement of each of five load steps of plain Newton.

    A step ends where R_k / R_1 < 1e-5, as in Caribou.
    """
    state = None
    for step in range(1, 6):
        part = step / 5 * force
        solver = fem.Newton(
            problem, tol=1e-15, mixed_integration=False, linear="superlu", factor_reuse_tol=0.0
        )
        norms = []
        for iterate in solver.iterate(load_of(part[None]), guess=state):
            state = iterate.displacement
            norms.append(problem.residual(state, part).norm().item())
            if len(norms) > 2 and norms[-1] < 1e-5 * norms[1]:
                break
        yield [norm / norms[1] for norm in norms[2:]], state


def end_face(problem: fem.Problem, state: Tensor) -> list[float]:
    """Return where the centre of the end face comes to lie, from the beam's axis [m]."""
    centre = node_at(problem, 7.5, 7.5, 80.0)
    return (80 * (problem.points + state[0])[centre] - torch.tensor([7.5, 7.5, 0.0])).tolist()


def test_beam_of_caribou_has_its_residuals_and_its_end():
    """Caribou's static beam: 19 ratios to 1e-10, the centre of the end face to all digits."""
    problem, force = caribou(1)
    steps = list(load_steps(problem, force))
    for (ratios, _), printed in zip(steps, CARIBOU, strict=True):
        assert ratios == pytest.approx(printed, rel=0, abs=1e-10)
    state = steps[-1][1]
    assert end_face(problem, state) == pytest.approx([0, -21.0164, 76.1898], abs=1e-4)
    answer = fem.solve(fem.Newton(problem), load_of(force[None]))
    assert end_face(problem, answer.displacement) == pytest.approx([0, -21.0164, 76.1898], abs=1e-3)


COOK_OF = [  # law, degree, cells a side, u_y at (48, 52) [mm]
    *(
        (K4, d, n, text)
        for d, row in FINER.items()
        for n, text in zip(SIDES, row.split(), strict=False)
    ),
    *((law, degree, 8, text) for _, law, degree, text in OTHERS),
]


def digits(printed: str):
    """Return what a value must equal to have these digits, the last of them rounded."""
    unit = 10.0 ** int(Decimal(printed).as_tuple().exponent)
    return pytest.approx(float(printed), rel=0, abs=0.51 * unit)


@pytest.mark.parametrize(("law", "degree", "count", "printed"), COOK_OF)
def test_membrane_of_cook_rises_as_tabulated(law, degree, count, printed):
    """Cook's membrane by an independent code."""
    problem, u = membrane(law, count, degree)
    assert at(problem, u, (48, 52))[1] == digits(printed)
    if (law, degree, count) == (K4, 2, 8):
        assert at(problem, u, (48, 60)) == (digits("-13.8264"), digits("13.7505"))


# dolfinx tutorial, hyperelasticity: degree, n -> u of (20, 1, 1) [m], plain iterations
DOLFINX = {
    (2, 1): (-0.456847, -1.8e-5, -4.554805),
    (2, 3): (-3.152621, -7.2e-5, -10.444325),
    (2, 5): (-5.562813, -1.25e-4, -13.189922),
    (2, 9): (-8.573525, -2.21e-4, -15.511486),
    (1, 1): (None, None, -3.341340),
    (1, 9): (None, None, -14.300877),
}
DOLFINX_ITERATIONS = [7, 8, 9, 8, 7, 6, 6, 5, 5]


@pytest.mark.parametrize(
    ("degree", "mixed"),
    [(1, False), *(pytest.param(2, mixed, marks=pytest.mark.slow) for mixed in (False, True))],
)
def test_beam_of_the_dolfinx_tutorial_bends_as_computed(degree, mixed):
    """Beam of the dolfinx tutorial: nine loads, each from the previous solution, no load steps."""
    mesh = fem.box([20.0, 1.0, 1.0], [21, 6, 6])
    problem = fem.Problem.build(mesh, NH, fixed=fem.Plane(0, "min"), degree=degree)
    unit = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -1.5 / 1e4]).on(problem)
    corner, state = node_at(problem, 20, 1, 1), None
    for n, count in enumerate(DOLFINX_ITERATIONS, 1):
        answer = resumed(problem, n * unit, state, tol=1e-9, mixed_integration=mixed)
        assert answer.status.item() == fem.Status.CONVERGED
        # theirs is over the first residual; a factor that is used again may cost one more
        assert answer.iterations.item() <= count + 2
        state = answer.displacement
        for found, printed in zip(
            20 * state[0, corner], DOLFINX.get((degree, n), [None] * 3), strict=True
        ):
            assert printed is None or found.item() == pytest.approx(printed, abs=5.1e-7)
    if degree == 2:
        energy = problem.energy(state).item() * 1e4 * 20**3
        assert energy == pytest.approx(56.966619, abs=5e-7)


@pytest.mark.parametrize(
    ("cells", "degree"),
    [pytest.param(*c, marks=pytest.mark.slow if c[0][0] * c[1] > 4 else []) for c in TWIST],
)
def test_column_follows_the_rotation_of_its_end(cells, degree):
    """Torque, axial force and energy of a column whose end is turned by 90 degrees."""
    (found,), *_ = twisted(cells, degree, [math.pi / 2])
    torque, axial, energy = map(float, TWIST[cells, degree])
    assert found[0] == pytest.approx(torque, rel=1e-9)
    assert found[1] == pytest.approx(axial, rel=2e-9)
    assert found[2] == pytest.approx(energy, rel=1e-10)


HEX, TET = list(KINDS)[:2]


def tip(name: str, alpha: float) -> tuple[float, float]:
    """Return w / L and u / L of the end section of a bar 20 x 1 x 1 of SVK, nu = 0."""
    problem = slender(fem.SaintVenantKirchhoff(0.0), *KINDS[name])
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -alpha / 12 / 400]).on(problem)
    u = balanced(fem.Newton(problem), force).displacement[0]
    return -mean(u[:, 2], force[:, 2]), -mean(u[:, 0], force[:, 2])


@pytest.mark.parametrize("alpha", SAME)
@pytest.mark.parametrize("name", [HEX, TET])
def test_slender_bar_of_quadratic_elements_is_the_elastica(name, alpha):
    """Elastica, Bisshopp and Drucker (1945), within 0.6 %; hex27 to the digits of the table."""
    found = tip(name, alpha)
    assert found == pytest.approx([*map(float, BENT[alpha])], rel=6e-3)
    assert name == TET or found[0] == digits(SAME[alpha])


@pytest.mark.parametrize("name", LOCKED)
def test_slender_bar_of_linear_elements_locks_as_tabulated(name):
    """In per cent of the elastica at P L^2 / EI = 1."""
    assert 100 * (tip(name, 1.0)[0] / float(BENT[1.0][0]) - 1) == digits(LOCKED[name])

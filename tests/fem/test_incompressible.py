"""Nearly incompressible bodies: closed forms of the incompressible limit, and locking."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import skfem
import torch
from solving import poisson, without_load

from dpl import fem
from dpl.fem.loads import traction

NU = poisson(1e5)
FORMULATIONS = {"mean dilatation": {"mean_dilatation": True}, "quadratic": {"degree": 2}}


def slopes(law: fem.Material) -> Callable[[float, float], tuple[float, float]]:
    """Return dW/dI1 and dW/dI2 at J = 1 as functions of I1 and I2."""
    if isinstance(law, fem.MooneyRivlinK2):
        return lambda i1, i2: (law.c10, law.c01)
    if isinstance(law, fem.YeohK2):
        return lambda i1, i2: (law.c10 + 2 * law.c20 * (i1 - 3) + 3 * law.c30 * (i1 - 3) ** 2, 0.0)
    mu = float(law.mu)
    if isinstance(law, fem.StableNeoHookean):  # m/2 (I1 - 3) - m/2 ln(I1 + 1), m = 4 mu/3
        return lambda i1, i2: (2 / 3 * mu * (1 - 1 / (i1 + 1)), 0.0)
    return lambda i1, i2: (mu / 2, 0.0)


RUBBERS = {
    "NH-ln": fem.NeoHookeanLn(NU),
    "NHiso-k2": fem.NeoHookeanIsoK2(NU),
    "NHiso-k4": fem.NeoHookeanIsoK4(NU),
    "SNH": fem.StableNeoHookean(NU),
    "MR": fem.MooneyRivlinK2(0.15, 0.05, 4e4),
    "Yeoh": fem.YeohK2(0.2, -0.02, 0.005, 4e4),
}
DILATED = {"NH-ln", "NHiso-k2"}  # the loops of a law with mean dilatation are long to compile
MODES = {  # stretch -> principal stretches, the directions that are pulled, P11 of W1 and W2
    "uniaxial": (lambda s: (s, s**-0.5, s**-0.5), 1, lambda s: (s - s**-2, 1 / s)),
    "equibiaxial": (lambda s: (s, s, s**-2), 2, lambda s: (s - s**-5, s**2)),
    "pure shear": (lambda s: (s, 1.0, 1 / s), 2, lambda s: (s - s**-3, 1.0)),
}


CASES = [
    pytest.param(
        *(name, mode, kind),
        marks=[pytest.mark.slow]
        * ((name != "NH-ln" and k != number % 3) or (not degree and name not in DILATED)),
    )
    for number, name in enumerate(RUBBERS)
    for k, mode in enumerate(MODES)
    for degree, kind in enumerate(FORMULATIONS)
]


@pytest.mark.parametrize(("name", "mode", "formulation"), CASES)
def test_stretched_rubber_has_the_stress_of_the_incompressible_limit(grid, name, mode, formulation):
    """P11 of the incompressible law on a distorted mesh; bulk over shear modulus 1e5."""
    law, formulation = RUBBERS[name], FORMULATIONS[formulation]
    stretches, pulled, factors = MODES[mode]
    mesh = grid("hexahedron", 2, 0.2, inside=True)
    points = fem.Problem.build(mesh, law, length=1.0, **formulation).points.numpy()
    far, held = points > 1 - 1e-9, points < 1e-9
    held[:, :pulled] |= far[:, :pulled]
    for stretch in (0.7, 2.0):
        principal = np.array(stretches(stretch))
        given = np.where(far, principal - 1, 0.0)
        problem = fem.Problem.build(
            mesh, law, fixed=held, prescribed=given, length=1.0, **formulation
        )
        guess = problem.points * torch.from_numpy(principal - 1)
        answer = without_load(problem, guess[None])
        assert answer.converged.all()
        pull = problem.internal_force(answer.displacement)[0, far[:, 0], 0].sum().item()
        W1, W2 = slopes(law)((principal**2).sum(), (principal**-2.0).sum())
        first, second = factors(stretch)
        assert pull == pytest.approx(2 * first * (W1 + second * W2), rel=1e-3), stretch


def octant(cells: int, layers: int, thickness: float) -> skfem.MeshHex2:
    """Return an octant of a sphere with the inner radius 1: three blocks of curved hex27."""
    block = fem.box([thickness, 1.0, 1.0], [layers + 1, cells + 1, cells + 1])
    radius = 1 + block.p[0]
    face = radius * np.stack([np.ones_like(radius), *block.p[1:]])
    parts = [skfem.MeshHex(np.roll(face, axis, axis=0), block.t) for axis in range(3)]
    flat = skfem.MeshHex2.from_mesh(parts[0] + parts[1] + parts[2])
    radius = flat.doflocs.max(axis=0)
    direction = np.tan(np.pi / 4 * flat.doflocs / radius)
    return skfem.MeshHex2(radius * direction / np.linalg.norm(direction, axis=0), flat.t)


def blown_up(
    mesh: skfem.MeshHex2, law: fem.Material, stretch: float
) -> tuple[fem.Problem, fem.Solution]:
    """Return an eighth of a sphere whose inner radius 1 has grown, and its answer."""
    points = fem.Problem.build(mesh, law, length=1.0).points
    radius = points.norm(dim=1)
    inside = radius < 1 + 1e-9
    held = (points < 1e-9) | inside[:, None]
    given = torch.where(inside[:, None], (stretch - 1) * points, 0.0)
    problem = fem.Problem.build(
        mesh, law, fixed=held.numpy(), prescribed=given.numpy(), degree=2, length=1.0
    )
    grown = (radius**3 + stretch**3 - 1) ** (1 / 3)  # as an incompressible body does
    guess = ((grown / radius - 1)[:, None] * points)[None]
    return problem, without_load(problem, guess)


def pressure_inside(problem: fem.Problem, answer: fem.Solution, stretch: float) -> float:
    """Return the pressure in the hole of an octant: work per change of its volume.

    The hole is blown up by its displacement: so the pressure, which in nature follows the surface
    and its normal, need not be applied as a load, and its limit point is passed.
    """
    inside = problem.points.norm(dim=1) < 1 + 1e-9
    reaction = problem.internal_force(answer.displacement)[0, inside]
    return (reaction * problem.points[inside]).sum().item() / (math.pi / 2 * stretch**2)


SPHERES = [(1.1, 0.2871548459), (1.5, 0.7554331187), (2.0, 0.8069266031), (3.0, 0.6345066752)]


@pytest.mark.parametrize(("stretch", "printed"), SPHERES)
def test_thick_sphere_has_the_inner_pressure_of_the_closed_form(stretch, printed):
    """The pressure is mu (f(b) - f(a)) / 2, f = s^-4 + 4 / s, s the stretches at radii 1 and 2."""
    law = fem.NeoHookeanIsoK2(poisson(1e4))
    problem, answer = blown_up(octant(2, 32, 1.0), law, stretch)
    assert answer.status.item() == fem.Status.CONVERGED
    pressure = pressure_inside(problem, answer, stretch)
    assert pressure / law.mu == pytest.approx(printed, rel=1e-3)


@pytest.mark.filterwarnings("ignore:.*rounding allows no less")
def test_balloon_has_its_largest_pressure_at_the_sixth_root_of_seven():
    """Thin neo-Hookean sphere: p R / (2 mu H) = 1 / s - 1 / s^7; here H / R = 1e-3."""
    law, peak = fem.NeoHookeanIsoK2(poisson(1e4)), 7 ** (1 / 6)
    mesh, found = octant(4, 1, 0.001), {}
    for stretch in (0.97 * peak, peak, 1.03 * peak):
        problem, answer = blown_up(mesh, law, stretch)
        assert answer.converged.all()
        found[stretch] = pressure_inside(problem, answer, stretch) / (2 * float(law.mu) * 1e-3)
    assert found[peak] == pytest.approx(0.6197314512, rel=2e-3)
    assert found[peak] > max(found[0.97 * peak], found[1.03 * peak])


CYLINDER = {0.3: 4.5825e-3, 0.49: 5.039925e-3, 0.499: 5.06024925e-3, 0.4999: 5.062274992e-3}


def bore(nu: float, cells: tuple[int, int], **options) -> float:
    """Return u_r at the bore of the thick cylinder of MacNeal and Harder, p = 1, E = 1000.

    It is the linear solution: mean dilatation is for laws of finite strain, whose K(0) is Hooke's.
    """
    law = fem.NeoHookeanLn(nu) if options.get("mean_dilatation") else fem.LinearElastic(nu)
    polar = skfem.MeshQuad.init_tensor(
        np.linspace(3, 9, cells[0] + 1), np.linspace(0, np.pi / 2, cells[1] + 1)
    )
    if options.get("degree") == 2:
        polar = skfem.MeshQuad2.from_mesh(polar)
    radius, angle = polar.doflocs
    mesh = type(polar)(np.stack([radius * np.cos(angle), radius * np.sin(angle)]), polar.t)
    points = fem.Problem.build(mesh, law, length=1.0, **options).points.numpy()
    fixed = np.abs(points) < 1e-9
    problem = fem.Problem.build(mesh, law, fixed=fixed, length=1.0, **options)
    force = traction(
        problem,
        lambda x: np.linalg.norm(x, axis=1) < 3 + 1e-6,
        lambda x: x / np.linalg.norm(x, axis=0) / 1000,
    )
    answer = fem.solve(fem.LinearSolver(problem), fem.Load(force[None], torch.ones(1)))
    return answer.displacement[0, np.abs(points - [3, 0]).sum(axis=1).argmin(), 0].item()


@pytest.mark.parametrize("nu", CYLINDER)
def test_thick_cylinder_with_mean_dilatation_converges_with_second_order(nu):
    """MacNeal, Harder (1985), thick-walled cylinder."""
    coarse, fine = (bore(nu, (n, n - 4), mean_dilatation=True) / CYLINDER[nu] for n in (20, 40))
    assert coarse == pytest.approx(1.0, abs=1.1e-3)
    assert math.log2((coarse - 1) / (fine - 1)) > 1.9


@pytest.mark.parametrize(
    ("nu", "dilated", "within"),
    [
        *((nu, True, 1e-6) for nu in CYLINDER),
        *((0.3, False, 2e-6), (0.49, False, 3e-5), (0.499, False, 3e-4)),
    ],
)
def test_thick_cylinder_of_quadratic_elements_has_the_closed_form(nu, dilated, within):
    """MacNeal, Harder (1985); without mean dilatation the error grows with the bulk modulus."""
    found = bore(nu, (20, 16), degree=2, mean_dilatation=dilated)
    assert found == pytest.approx(CYLINDER[nu], rel=within)


@pytest.mark.filterwarnings("ignore:linear .* lock")
@pytest.mark.parametrize(("nu", "short"), [(0.49, 0.086), (0.499, 0.477), (0.4999, 0.901)])
def test_thick_cylinder_of_plain_linear_elements_locks(nu, short):
    """MacNeal, Harder (1985), 10 x 8 cells."""
    assert 1 - bore(nu, (10, 8)) / CYLINDER[nu] == pytest.approx(short, abs=1e-3)

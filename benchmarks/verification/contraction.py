"""Active problem of the cardiac mechanics benchmark: a contracting ventricle.

Source: Land et al. (2015), Proc. R. Soc. A 471:20150641, problem 3. The sources of the digits are
those of `benchmarks.verification.cardiac`.
"""

from collections.abc import Sequence
from pathlib import Path

from benchmarks.verification.cardiac import SPREAD
from benchmarks.verification.continuation import follow
from benchmarks.verification.drawing import measured, panel, picture
from benchmarks.verification.report import Row, Section
from benchmarks.verification.ventricle import apex, endocardium, ventricle
from dpl.fem import (
    ActiveStress,
    DirichletBC,
    FibreData,
    FibreReinforced,
    FollowerPressure,
    Guccione,
    Plane,
    Problem,
    VolumetricK4,
)

ENDO, EPI = "-12.347", "-15.452"  # z of the deformed apex [mm]
LAYERS = (2, 3, 4)  # through the wall
PATCH, RINGS = 2, 6  # cells along a half side of the patch, and rings around it
BULKS = (1e2, 3e2, 1e3, 4e3)  # [kPa]
LOAD_STEPS = (0.02, 0.06, 0.15, 0.3, 0.6, 1.0)  # parts of pressure and active stress


def contracted(layers: int, bulk: float, patch: int = PATCH, rings: int = RINGS) -> Problem:
    """Return the ventricle under 15 kPa with an active stress of 60 kPa along its fibres."""
    wall = ventricle(patch, rings, layers)
    muscle = Guccione(2.0, 8.0, 2.0, 4.0)
    return Problem.build(
        wall.mesh,
        FibreReinforced(VolumetricK4(bulk), muscle, FibreData(wall.fibres())),
        supports=[DirichletBC(Plane(2, "max"))],
        degree=2,
        follower_loads=[FollowerPressure(endocardium, 15.0), ActiveStress(60.0)],
        length=1.0,
    )


def contracted_apex(
    layers: int, bulks: Sequence[float] = BULKS, patch: int = PATCH, rings: int = RINGS
) -> list[tuple[float, float]]:
    """Return z [mm] of the deformed apex, inside and outside, for bulk moduli [kPa]."""
    problem = contracted(layers, bulks[0], patch, rings)
    points = problem.points.numpy() + problem.origin
    nodes = [apex(points, depth) for depth in (0.0, 1.0)]
    *_, first = follow(problem.with_follower_factor, LOAD_STEPS)
    inverse = [1 / bulk for bulk in bulks]
    solutions = follow(lambda x: contracted(layers, 1 / x, patch, rings), inverse, first)
    found = [[points[node, 2] + float(u[0, node, 2]) for node in nodes] for u in solutions]
    return [(inner, outer) for inner, outer in found]


def contraction(folder: Path) -> Section:
    """Solve problem 3 with a growing number of layers of cells."""
    found = {layers: contracted_apex(layers) for layers in LAYERS}
    rows = []
    for k, (side, text) in enumerate((("endo", ENDO), ("epi", EPI))):
        for layers in LAYERS:
            name = f"{layers} layers, κ = {BULKS[-1]:g} kPa: z of the apex, {side} [mm]"
            rows.append(Row(name, text, found[layers][-1][k], SPREAD))
    with picture(folder / "contraction.png", 2.9) as figure:
        axes = panel(figure, 1, "bulk modulus [kPa]", "z of the apex, endo [mm]", "")
        for k, layers in enumerate(LAYERS):
            measured(axes, BULKS, [inner for inner, _ in found[layers]], k, f"{layers} layers")
        axes.axhline(float(ENDO), color="black", linewidth=0.8)
        axes.set_xscale("log")
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return Section(
        "Cardiac benchmark: contraction",
        "Problem 3 of Land et al. (2015, Proc. R. Soc. A 471:20150641): the ellipsoid of problem 2 "
        "with C = 2 kPa, b_f = 8, b_t = 2, b_fs = 4, fibres at −90° (outside) to +90° (inside) to "
        "the circumference, a pressure of 15 kPa inside and an active stress (second "
        "Piola-Kirchhoff) of 60 kPa along the fibres, both raised together. The whole ellipsoid is "
        f"meshed with hexahedra of degree 2: {2 * PATCH} × {2 * PATCH} cells at the apex and "
        f"{RINGS} rings of {8 * PATCH} cells. References: as in the passive problems. Each cell "
        "has one fibre direction, so that the direction makes a step of 180°/n between n layers. "
        "The tolerance is 0.5 %, as in the passive problems.",
        rows,
        [("contraction.png", "z of the apex inside against the bulk modulus; line: reference.")],
        [
            "The differences are larger than those between the codes of the paper, and these "
            "meshes do not show convergence. The step of the fibre direction between layers may be "
            "a cause, which was not tested separately; directions at the quadrature points are not "
            "implemented."
        ],
    )

"""Passive problems of the cardiac mechanics benchmark: a bending beam and an inflated ventricle.

Source: Land et al. (2015), Proc. R. Soc. A 471:20150641, problems 1 and 2. The paper compares 11
codes in figures; its abstract gives a typical difference of 0.5 % between fine solutions, which is
the tolerance here. The digits of the references are those of one of these codes, FEniCS with
Taylor-Hood elements (Pezzuto, Simula): the finest meshes in summary_results.txt of
github.com/finsberg/mechbench.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.verification.continuation import follow
from benchmarks.verification.drawing import measured, panel, picture
from benchmarks.verification.report import Row, Section
from benchmarks.verification.ventricle import apex, endocardium, ventricle
from dpl.fem import (
    ConstantFibres,
    DirichletBC,
    FibreReinforced,
    FollowerPressure,
    Guccione,
    Plane,
    Problem,
    VolumetricK4,
    box,
)

Cells = tuple[int, int, int]
SPREAD = 5e-3  # between the codes of the paper
TIP = "4.1695"  # z of the deformed point (10, 0.5, 1) [mm]
ENDO, EPI = "-26.612", "-28.279"  # z of the apex of the inflated ventricle [mm]
BEAMS: tuple[Cells, ...] = ((10, 2, 2), (20, 4, 4), (30, 6, 6))
VENTRICLES: tuple[Cells, ...] = ((2, 6, 1), (2, 8, 2), (4, 14, 3))  # patch, rings, layers
BEAM_BULK, VENTRICLE_BULK = (2e2, 2e3, 2e4), (1e2, 3e2, 1e3)  # [kPa]
# parts of the pressure, small while the ventricle expands most
PRESSURE_STEPS = (0.04, 0.08, 0.12, 0.16, 0.2, 0.24, 0.28, 0.33, 0.4, 0.5, 0.7, 1.0)


def beam(cells: Cells, bulk: float) -> Problem:
    """Return the bar 10 x 1 x 1 mm with fibres along x; cells are smaller near the fixed end."""
    mesh = box([1.0, 1.0, 1.0], [n + 1 for n in cells])
    x, y, z = mesh.p
    law = FibreReinforced(
        VolumetricK4(bulk), Guccione(2.0, 8.0, 2.0, 4.0), ConstantFibres([1, 0, 0])
    )
    return Problem.build(
        replace(mesh, doflocs=np.stack([10 * x**2, y, z])),
        law,
        fixed=Plane(0, "min"),
        degree=2,
        follower_loads=[FollowerPressure(Plane(2, "min"), 0.004)],
        length=1.0,
    )


def beam_tips(cells: Cells, bulks: Sequence[float] = BEAM_BULK) -> list[float]:
    """Return z [mm] of the deformed point (10, 0.5, 1) for bulk moduli [kPa]."""
    problem = beam(cells, bulks[0])
    points = problem.points.numpy() + problem.origin
    node = int(np.linalg.norm(points - [10.0, 0.5, 1.0], axis=1).argmin())
    solutions = follow(lambda x: beam(cells, 1 / x), [1 / bulk for bulk in bulks])
    return [1.0 + float(u[0, node, 2]) for u in solutions]


def inflated(cells: Cells, bulk: float) -> Problem:
    """Return a quarter of the isotropic ventricle under 10 kPa."""
    law = FibreReinforced(
        VolumetricK4(bulk), Guccione(10.0, 1.0, 1.0, 1.0), ConstantFibres([1, 0, 0])
    )
    return Problem.build(
        ventricle(*cells, quarter=True).mesh,
        law,
        supports=[
            DirichletBC(Plane(0, 0.0), [0.0, None, None]),
            DirichletBC(Plane(1, 0.0), [None, 0.0, None]),
            DirichletBC(Plane(2, "max")),
        ],
        degree=2,
        follower_loads=[FollowerPressure(endocardium, 10.0)],
        length=1.0,
    )


def inflated_apex(
    cells: Cells, bulks: Sequence[float] = VENTRICLE_BULK
) -> list[tuple[float, float]]:
    """Return z [mm] of the deformed apex, inside and outside, for bulk moduli [kPa]."""
    problem = inflated(cells, bulks[0])
    points = problem.points.numpy() + problem.origin
    nodes = [apex(points, depth) for depth in (0.0, 1.0)]
    *_, first = follow(problem.with_follower_factor, PRESSURE_STEPS)
    solutions = follow(lambda x: inflated(cells, 1 / x), [1 / bulk for bulk in bulks], first)
    found = [[points[node, 2] + float(u[0, node, 2]) for node in nodes] for u in solutions]
    return [(inner, outer) for inner, outer in found]


def cardiac(folder: Path) -> Section:
    """Solve problems 1 and 2 on refined meshes and for rising bulk moduli."""
    rows, tips, apices = [], {}, {}
    for cells in BEAMS:
        tips[cells] = beam_tips(cells)
        name = f"beam, {' × '.join(map(str, cells))} hex27"
        within = 0.01 if cells == BEAMS[0] else SPREAD
        rows += [
            Row(f"{name}, κ = {bulk:g} kPa: z of (10, 0.5, 1) [mm]", TIP, z, within)
            for bulk, z in zip(BEAM_BULK, tips[cells], strict=True)
        ]
    for cells in VENTRICLES:
        apices[cells] = inflated_apex(cells)
        name = "ventricle, {} in the patch, {} rings, {} layers of hex27".format(*cells)
        for bulk, places in zip(VENTRICLE_BULK, apices[cells], strict=True):
            within = 0.01 if cells == VENTRICLES[0] else SPREAD
            for side, text, z in zip(("endo", "epi"), (ENDO, EPI), places, strict=True):
                rows.append(
                    Row(f"{name}, κ = {bulk:g} kPa: z of the apex, {side} [mm]", text, z, within)
                )
    _draw(folder / "cardiac.png", tips, apices)
    return Section(
        "Cardiac benchmark: passive muscle",
        "Problems 1 and 2 of Land et al. (2015, Proc. R. Soc. A 471:20150641), Guccione's law. "
        "(1) A bar 10 × 1 × 1 mm (C = 2 kPa, b_f = 8, b_t = 2, b_fs = 4, fibres along x) is fixed "
        "at x = 0 and has a follower pressure of 4 Pa on the face z = 0. (2) A truncated ellipsoid "
        "(C = 10 kPa, all b = 1; half axes of 7 and 17 mm inside, 10 and 20 mm outside, base at "
        "z = 5 mm) is fixed at its base and has an inner pressure of 10 kPa; a quarter is meshed, "
        "without a pole at the apex. The muscle of the paper is incompressible; here it has the "
        "volumetric energy κ/4 (J² − 1 − 2 ln J). The paper shows the solutions of 11 codes in "
        "figures and reports differences of typically 0.5 % between them, which is the tolerance "
        "(1 % on the coarsest meshes). The digits of the references are those of one of these "
        "codes on its finest meshes, FEniCS with Taylor-Hood elements (Pezzuto, "
        "summary_results.txt in github.com/finsberg/mechbench).",
        rows,
        [("cardiac.png", "Relative difference from the reference against the bulk modulus.")],
        [
            "On each mesh of the ventricle the difference grows with the bulk modulus, which is at "
            "most 200 times the shear modulus there. The cause was not found."
        ],
    )


def _draw(
    place: Path,
    tips: dict[Cells, list[float]],
    apices: dict[Cells, list[tuple[float, float]]],
) -> None:
    log = {"xscale": "log", "yscale": "log"}
    with picture(place, 3.1) as figure:
        ax = panel(figure, 1, "bulk modulus [kPa]", "|difference| [-]", "(a) beam, tip", **log)
        for k, (cells, values) in enumerate(tips.items()):
            off = [abs(z / float(TIP) - 1) for z in values]
            measured(ax, BEAM_BULK, off, k, " × ".join(map(str, cells)))
        ax.legend()
        ax = panel(figure, 2, "bulk modulus [kPa]", "", "(b) ventricle, apex inside", **log)
        for k, (cells, places) in enumerate(apices.items()):
            off = [abs(inner / float(ENDO) - 1) for inner, _ in places]
            measured(ax, VENTRICLE_BULK, off, k, "{}, {}, {}".format(*cells))
        ax.legend()

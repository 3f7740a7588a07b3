"""The cardiac mechanics benchmark: a bending beam, an inflated and a contracting ventricle.

Source: Land et al. (2015), Proc. R. Soc. A 471:20150641, problems 1, 2 and 3. The paper compares 11
codes in figures; its abstract gives a typical difference of 0.5 % between fine solutions, which is
the tolerance here. The digits of the references are those of one of these codes, FEniCS with
Taylor-Hood elements (Pezzuto, Simula): the finest meshes in summary_results.txt of
github.com/finsberg/mechbench.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.study import picture
from benchmarks.verification.bodies import balanced
from benchmarks.verification.drawing import measured, panel
from benchmarks.verification.report import Row, Section
from benchmarks.verification.ventricle import apex, endocardium, fibres, ventricle
from dpl import fem

Cells = tuple[int, int, int]
SPREAD = 5e-3  # between the codes of the paper
TOL = 1e-6  # relative residual: rounding allows 1e-7 at the largest bulk modulus
TIP = "4.1695"  # z of the deformed point (10, 0.5, 1) [mm]
ENDO, EPI = "-26.612", "-28.279"  # z of the apex of the inflated ventricle [mm]
END_ENDO, END_EPI = "-12.347", "-15.452"  # the same of the contracting ventricle [mm]
BEAMS: tuple[Cells, ...] = ((10, 2, 2), (20, 4, 4), (30, 6, 6))
VENTRICLES: tuple[Cells, ...] = ((2, 6, 1), (2, 8, 2), (4, 14, 3))  # patch, rings, layers
CONTRACTED = ((2, 6, 2), (3, 9, 3), (4, 12, 4))
BULKS = (1e2, 1e3, 1e4, 1e5)  # [kPa]; the last is 1e4 times the shear moduli at rest and more


def beam(cells: Cells, bulk: float, cell: str = "hexahedron") -> fem.Problem:
    """Return the bar 10 x 1 x 1 mm with fibres along x; cells are smaller near the fixed end."""
    mesh = fem.box([1.0, 1.0, 1.0], [n + 1 for n in cells], cell)
    x, y, z = mesh.p
    law = fem.FibreReinforced(
        fem.VolumetricK4(bulk), fem.Guccione(2.0, 8.0, 2.0, 4.0), fem.ConstantFibres([1, 0, 0])
    )
    return fem.Problem.build(
        replace(mesh, doflocs=np.stack([10 * x**2, y, z])),
        law,
        fixed=fem.Plane(0, "min"),
        degree=2,
        mean_dilatation=True,
        follower_loads=[fem.FollowerPressure(fem.Plane(2, "min"), 0.004)],
        length=1.0,
    )


def beam_tip(
    cells: Cells, bulk: float = BULKS[-1], *, cell: str = "hexahedron"
) -> tuple[float, int]:
    """Return z [mm] of the deformed point (10, 0.5, 1), and the Newton iterations from rest."""
    problem = beam(cells, bulk, cell)
    points = problem.points.numpy() + problem.origin
    node = int(np.linalg.norm(points - [10.0, 0.5, 1.0], axis=1).argmin())
    solution = balanced(fem.Newton(problem, tol=TOL))
    return 1.0 + float(solution.displacement[0, node, 2]), int(solution.iterations)


def inflated(cells: Cells, bulk: float, cell: str = "hexahedron") -> fem.Problem:
    """Return a quarter of the isotropic ventricle under 10 kPa."""
    law = fem.FibreReinforced(
        fem.VolumetricK4(bulk), fem.Guccione(10.0, 1.0, 1.0, 1.0), fem.ConstantFibres([1, 0, 0])
    )
    return fem.Problem.build(
        ventricle(*cells, quarter=True, cell=cell),
        law,
        supports=[
            fem.DirichletBC(fem.Plane(0, 0.0), [0.0, None, None]),
            fem.DirichletBC(fem.Plane(1, 0.0), [None, 0.0, None]),
            fem.DirichletBC(fem.Plane(2, "max")),
        ],
        degree=2,
        mean_dilatation=True,
        follower_loads=[fem.FollowerPressure(endocardium, 10.0)],
        length=1.0,
    )


def apex_of(problem: fem.Problem) -> tuple[float, float, int]:
    """Return z [mm] of the deformed apex, inside and outside, and the iterations from rest."""
    points = problem.points.numpy() + problem.origin
    solution = balanced(fem.Newton(problem, tol=TOL))
    u = solution.displacement[0]
    nodes = [apex(points, depth) for depth in (0.0, 1.0)]
    inner, outer = (points[node, 2] + float(u[node, 2]) for node in nodes)
    return inner, outer, int(solution.iterations)


def cardiac(folder: Path) -> Section:
    """Solve problems 1 and 2 on refined meshes, and on one mesh for rising bulk moduli."""
    rows, counts = [], []
    for cells in BEAMS:
        z, count = beam_tip(cells)
        counts.append(count)
        name = f"beam, {' × '.join(map(str, cells))} hex27: z of (10, 0.5, 1) [mm]"
        rows.append(Row(name, TIP, z, SPREAD))
    apices = {cells: apex_of(inflated(cells, BULKS[-1])) for cells in VENTRICLES}
    for cells, (inner, outer, count) in apices.items():
        counts.append(count)
        name = "ventricle, {} in the patch, {} rings, {} layers of hex27".format(*cells)
        for side, text, z in (("endo", ENDO, inner), ("epi", EPI, outer)):
            rows.append(Row(f"{name}: z of the apex, {side} [mm]", text, z, SPREAD))
    tips = [beam_tip(BEAMS[1], bulk) for bulk in BULKS]
    ends = [apex_of(inflated(VENTRICLES[1], bulk)) for bulk in BULKS]
    _draw(folder / "cardiac.png", [z for z, _ in tips], [inner for inner, *_ in ends])
    return Section(
        "Cardiac benchmark: passive muscle",
        "Land et al. 2015 (Proc. R. Soc. A 471:20150641), problems 1 and 2",
        "A bar of 10 × 1 × 1 mm and a truncated ellipsoid, Guccione's law with κ = 100 MPa in "
        "place of incompressibility, hex27 with `mean_dilatation`, Newton's method from rest. The "
        "tolerance of 0.5 % is the typical difference of the paper's 11 codes; digits are those "
        "of FEniCS (Pezzuto, github.com/finsberg/mechbench).",
        rows,
        f"Newton iterations, load steps included: {', '.join(map(str, counts))} (three beams, "
        "three ventricles); for κ = 0.1, 1, 10 and 100 MPa "
        + ", ".join(str(count) for _, count in tips)
        + " (beam) and "
        + ", ".join(str(count) for *_, count in ends)
        + " (ventricle).",
    )


def _draw(place: Path, tips: list[float], apices: list[float]) -> None:
    with picture(place, 3.1) as figure:
        panels = (
            ("z of the tip [mm]", "(a) beam", tips, TIP),
            ("z of the apex, endo [mm]", "(b) ventricle", apices, ENDO),
        )
        for k, (label, title, values, known) in enumerate(panels):
            ax = panel(figure, k + 1, "bulk modulus [kPa]", label, title, xscale="log")
            measured(ax, BULKS, values, k)
            ax.axhline(float(known), color="black", linewidth=0.8)


def contracted(patch: int, rings: int, layers: int, bulk: float = BULKS[-1]) -> fem.Problem:
    """Return the ventricle under 15 kPa with an active stress of 60 kPa along its fibres."""
    muscle = fem.Guccione(2.0, 8.0, 2.0, 4.0)
    return fem.Problem.build(
        ventricle(patch, rings, layers),
        fem.FibreReinforced(fem.VolumetricK4(bulk), muscle, fem.FibreFunction(fibres)),
        supports=[fem.DirichletBC(fem.Plane(2, "max"))],
        degree=2,
        mean_dilatation=True,
        follower_loads=[fem.FollowerPressure(endocardium, 15.0), fem.ActiveStress(60.0)],
        length=1.0,
    )


def contraction(folder: Path) -> Section:
    """Solve problem 3 on refined meshes."""
    found = {mesh: apex_of(contracted(*mesh)) for mesh in CONTRACTED}
    rows = []
    for k, (side, text) in enumerate((("endo", END_ENDO), ("epi", END_EPI))):
        for (patch, rings, layers), values in found.items():
            name = f"{patch} in the patch, {rings} rings, {layers} layers of hex27"
            rows.append(Row(f"{name}: z of the apex, {side} [mm]", text, values[k], SPREAD))
    with picture(folder / "contraction.png", 2.9) as figure:
        for k, (side, text) in enumerate((("endo", END_ENDO), ("epi", END_EPI))):
            label = f"z of the apex, {side} [mm]"
            axes = panel(figure, k + 1, "layers of cells", label, f"({'ab'[k]})")
            measured(axes, [mesh[-1] for mesh in CONTRACTED], [one[k] for one in found.values()], k)
            axes.axhline(float(text), color="black", linewidth=0.8)
            axes.set_xticks([mesh[-1] for mesh in CONTRACTED])
    counts = ", ".join(str(count) for *_, count in found.values())
    return Section(
        "Cardiac benchmark: contraction",
        "Land et al. 2015, problem 3",
        "The ellipsoid with fibres from −90° outside to +90° inside, a pressure of 15 kPa and an "
        "active stress of 60 kPa, κ = 100 MPa. References and tolerance as before.",
        rows,
        f"Newton iterations: {counts}. The inner apex converges slowly, since all fibres "
        "meet there.",
    )

"""Mean dilatation of quadratic triangles and tetrahedra: the bulk modulus at the points, pressures.

With the volume change projected on constants in each cell, coarse meshes are too soft. A part of
the shear modulus stays at the quadrature points as a bulk modulus
(`dpl.fem.assembly.mean_dilatation.POINT_SHEAR`). This case compares none, a half and the whole.
"""

from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from torch import Tensor

from benchmarks.verification.bodies import balanced
from benchmarks.verification.cardiac import BULKS, ENDO, TIP, apex_of, beam_tip, inflated
from benchmarks.verification.pressurised import expanded_radius, expansion, sector
from benchmarks.verification.refinement import at, loaded_membrane
from benchmarks.verification.report import Row, Section, table
from benchmarks.verification.taylor_hood import TaylorHood, taylor_hood
from dpl import fem
from dpl.fem.assembly.mean_dilatation import POINT_SHEAR
from dpl.fem.postprocess import cauchy

PARTS = (0.0, 0.5, 1.0)  # of the shear modulus that stay at the points
RATIOS = (0.3, 0.49, 0.4999)  # Poisson's ratios
PRESSED = 0.4999  # Poisson's ratio of the bodies whose pressures are compared
SHEARED = 38.49 / 16  # Young's modulus of Cook's membrane [N/mm2]
BULGE = 0.05  # prescribed displacement of the upper half of the block over its side
WITHIN = 0.025  # relative difference of a coarse mesh of tetrahedra
SPHERE, SPHERES = 0.2, (1, 2)  # pressure over E in the thick sphere, and cells through its wall
BARS, VENTRICLES = ((10, 2, 2),), ((2, 6, 1),)  # meshes of the cardiac benchmark
Loaded = tuple[fem.Problem, Tensor | None]


def membrane(nu: float, n: int, cell: str, degree: int) -> Loaded:
    """Return Cook's membrane of n cells a side with mean dilatation, and its forces."""
    law = fem.NeoHookeanIsoK2(nu)
    return loaded_membrane(law, n, degree, cell=cell, young=SHEARED, mean_dilatation=True)


def block(nu: float, n: int, cell: str, degree: int) -> Loaded:
    """Return an octant of a block 2 x 2 x 1, bonded to plates that press it by a tenth."""
    mesh, law = fem.box([1.0, 1.0, 0.5], [n + 1, n + 1, n // 2 + 1], cell), fem.NeoHookeanIsoK2(nu)
    points = fem.Problem.build(mesh, law, degree=degree, length=1.0).points.numpy()
    held, top = points < 1e-9, points[:, 2] > 0.5 - 1e-9
    held[top] = True
    given = np.where(top[:, None], [0.0, 0.0, -BULGE], 0.0)
    problem = fem.Problem.build(
        mesh, law, fixed=held, prescribed=given, degree=degree, length=1.0, mean_dilatation=True
    )
    return problem, None


def tip(problem: fem.Problem, u: Tensor, _: Tensor) -> float:
    """Return u_y at (48, 60) [mm] of the membrane."""
    return at(problem, u * problem.length, (48, 60))[1]


def press(problem: fem.Problem, _: Tensor, force: Tensor) -> float:
    """Return the force of a plate on the octant over E L^2."""
    return -float(force[problem.points[:, 2] > problem.points[:, 2].max() - 1e-9, 2].sum())


class Body(NamedTuple):
    """A body with a reference by Taylor-Hood elements."""

    name: str
    build: Callable[[float, int, str, int], Loaded]
    quantity: Callable[[fem.Problem, Tensor, Tensor], float]
    shape: str  # of its simplices
    meshes: tuple[int, ...]  # cells a side
    fine: int  # cells a side of the reference
    elements: tuple[
        tuple[str, str, int], ...
    ]  # name, cell and degree of those whose pressures are compared


MEMBRANE = Body(
    "Cook's membrane: u_y(48, 60) [mm]", membrane, tip, "triangle", (4, 8), 32,
    (("tri6", "triangle", 2), ("quad4", "quad", 1), ("quad9", "quad", 2)),
)  # fmt: skip
BLOCK = Body(
    "bonded block: force / (E L²)", block, press, "tetra", (2, 4), 6,
    (("tet10", "tetra", 2), ("hex8", "hexahedron", 1), ("hex27", "hexahedron", 2)),
)  # fmt: skip
BODIES = MEMBRANE, BLOCK
ELEMENT = {"triangle": "tri6", "tetra": "tet10"}


@cache
def known(body: Body, nu: float) -> tuple[float, TaylorHood]:
    """Return the quantity and the whole solution by Taylor-Hood elements on the fine mesh."""
    problem, force = body.build(nu, body.fine, body.shape, 2)
    found = taylor_hood(problem, nu, force)
    return body.quantity(problem, found.displacement, found.force), found


def solved(body: Body, nu: float, n: int, cell: str, degree: int) -> tuple[float, int]:
    """Return the quantity with mean dilatation, and the Newton iterations from rest."""
    problem, force = body.build(nu, n, cell, degree)
    solution = balanced(fem.Newton(problem), force)
    u = solution.displacement
    return body.quantity(problem, u[0], problem.internal_force(u)[0]), int(solution.iterations)


def pressure_errors(body: Body, n: int, cell: str, degree: int) -> tuple[float, float]:
    """Return rms errors over the rms pressure: at the points, and of the nodal field."""
    problem, force = body.build(PRESSED, n, cell, degree)
    u = balanced(fem.Newton(problem), force).displacement
    stress = cauchy(problem, u)[0]
    points = -stress.diagonal(dim1=-2, dim2=-1).mean(dim=-1).numpy()
    nodes = problem.basis.interpolate(fem.fields(problem, u).pressure[0].numpy())
    right = known(body, PRESSED)[1].pressure_at(np.asarray(problem.basis.global_coordinates()))
    weights = problem.basis.dx
    size = (right**2 * weights).sum()
    errors = [((np.asarray(p) - right) ** 2 * weights).sum() / size for p in (points, nodes)]
    return errors[0] ** 0.5, errors[1] ** 0.5


def cases() -> Iterator[tuple[str, str, Callable[[], tuple[float, int]]]]:
    """Yield name, reference, and a function of value and iterations (0: unknown) of all bodies."""
    for body, nu in product(BODIES, RATIOS):
        for n in body.meshes:
            name = f"{body.name}, {ELEMENT[body.shape]}, n = {n}, ν = {nu}"
            right = f"{known(body, nu)[0]:.5g}"
            yield name, right, partial(solved, body, nu, n, body.shape, 2)
    for nu, n in product(RATIOS, SPHERES):
        exact = f"{expanded_radius(nu, SPHERE, 3):.7g}"
        yield f"sphere: r/R, tet10, n = {n}, ν = {nu}", exact, partial(swollen, nu, n)
    for cells in BARS:
        mesh = " × ".join(map(str, cells))
        name = f"Land et al., problem 1: z of (10, 0.5, 1) [mm], tet10, {mesh} × 6"
        yield name, TIP, partial(beam_tip, cells, cell="tetra")
    for cells in VENTRICLES:
        mesh = "patch {}, rings {}, layers {}".format(*cells)
        name = f"Land et al., problem 2: z of the apex, endo [mm], tet10, {mesh}"
        yield name, ENDO, partial(sunk, cells)


def swollen(nu: float, n: int) -> tuple[float, int]:
    """Return r/R of the inner radius of the sphere of tet10, n cells through its wall."""
    mesh = sector(3, n, "tetra", quadratic=True)
    return expansion(nu, SPHERE, mesh, 2, mean_dilatation=True), 0


def sunk(cells: tuple[int, int, int]) -> tuple[float, int]:
    """Return z [mm] of the inner apex of the ventricle of tet10, and the Newton iterations."""
    inner, _, count = apex_of(inflated(cells, BULKS[-1], "tetra"))
    return inner, count


def dilatation(folder: Path) -> Section:
    """Compare bulk moduli at the points on five bodies, and pressures on two."""
    rows, lines, counts = list[Row](), list[list[str]](), list[int]()
    for name, right, run in cases():
        cells = [name, right]
        for part in PARTS:
            with patch("dpl.fem.assembly.discretisation.POINT_SHEAR", part):
                value, count = run()
            difference = f"{100 * (value / float(right) - 1):+.2f} %"
            cells.append(f"{difference} ({count})" if count else difference)
            if part == POINT_SHEAR:
                rows.append(Row(name, right, value, WITHIN))
                counts.append(count)
        lines.append(cells)
    most = max(counts[: len(RATIOS) * sum(len(body.meshes) for body in BODIES)])
    rows.append(Row("most Newton iterations of membrane and block", "< 8", most))
    pressures = [
        [body.name.partition(":")[0], name, str(n), *(f"{100 * x:.1f} %" for x in found)]
        for body in BODIES
        for name, cell, degree in body.elements
        for n in body.meshes
        for found in [pressure_errors(body, n, cell, degree)]
    ]
    coarse, fine = (known(BLOCK._replace(fine=n), PRESSED)[0] for n in (4, BLOCK.fine))
    header = ("body, n cells along a side", "reference", "constants alone", "μ/2", "μ")
    second = ("body", "element", "n", "pressure at the points", "nodal field")
    return Section(
        "Quadratic simplices with mean dilatation",
        "Taylor-Hood elements; radial equilibrium; Land et al. 2015",
        "The volume change is projected on constants in each cell; a part of the shear modulus "
        "stays at the points as a bulk modulus (dpl: μ/2). Cook's membrane of case 3 (NHiso-k2, "
        "E = 38.5 tractions), an octant of a block of 2 × 2 × 1 between bonded plates that press "
        "it by a tenth (NHiso-k2), the sphere of case 11 under 0.2 E, and both problems of case 12 "
        "(κ = 100 MPa). The first two references are Taylor-Hood elements (quadratic "
        "displacements, continuous linear pressures, energy and assembly without a line of dpl) "
        f"with {MEMBRANE.fine} and {BLOCK.fine} cells a side. Tolerance: 2.5 %.",
        rows,
        "Differences from the reference for three bulk moduli at the points, and Newton's "
        "iterations from rest in parentheses. Taylor-Hood elements with 4 cells a side differ by "
        f"{100 * (coarse / fine - 1):.1f} % from the reference of the block, which has an error of "
        "this size. On membrane and block μ/2 has the smallest largest difference.\n\n"
        + "\n".join(table(header, lines))
        + f"\n\nRoot mean square errors of the pressure -tr σ/3 at ν = {PRESSED} over that of the "
        "Taylor-Hood elements, of the elements with mean dilatation:\n\n"
        + "\n".join(table(second, pressures)),
    )

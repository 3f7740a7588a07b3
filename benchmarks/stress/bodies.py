"""Sizes, moduli, Poisson's ratios and aspect ratios of bodies: T7, T8, T10, T11."""

import warnings
from dataclasses import replace
from functools import cache, partial

import torch

from benchmarks.stress import fixtures
from benchmarks.stress.auditor import Auditor
from benchmarks.stress.case import Case, Outcome, classify
from benchmarks.stress.fixtures import as_load
from benchmarks.stress.loads import describe, newton_variants
from benchmarks.verification.refinement import LOCKING, POISSON, compliance
from benchmarks.verification.report import Row
from dpl import Scene, fem

SVK, NH = fem.SaintVenantKirchhoff(0.3), fem.NeoHookeanLn(0.3)
DIRECT = [name for name in fem.installed_backends() if name != "cg"]
UNIT_SYSTEMS = [
    (4500.0, 25.0), (1.0, 1e-3), (1.0, 1e3), (1e12, 1e-3), (1e12, 1e3),
]  # fmt: skip  # E [Pa], side [m]
REFERENCE_CORNER: list[tuple[str, fem.Material, tuple[str, str, str]]] = [  # u/L of the corner
    ("SVK", SVK, ("8.023468838e-3", "-2.392426382e-4", "-.2479226415")),
    ("NH-ln", NH, ("1.024683172e-2", "-2.397967447e-4", "-.2477360716")),
]
# T10: cells along a side, through the thickness, degree -> w at a/h = 100 and 10
PLATE_DEFLECTIONS = {
    (16, 1, 1): (".087", ".904"),
    (16, 2, 1): (".088", ".990"),
    (8, 1, 2): (".937", "1.119"),
    (16, 1, 2): (".982", "1.132"),
}
# T11: u_z/L
SLIVER_DEFLECTIONS = {1e-2: "-.2388289", 1e-4: "-.2386176", 1e-6: "-.2386155", 1e-8: "-.2386155"}
REFERENCE = cache(partial(compliance, cells=(16, 4, 4), cell="hexahedron", degree=2))  # of nu
ASPECTS = (1.0, 10.0, 100.0, 1000.0)


def unit_systems(law: fem.Material, printed: tuple[str, ...], auditor: Auditor) -> Outcome:
    """Bend the same beam in several systems of units, [N] to [m]."""
    rows, failures, counts = [], [], []
    for young, side in UNIT_SYSTEMS:
        mesh = fem.box([4 * side, side, side], [9, 3, 3])
        problem = fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"))
        newton = fem.Newton(problem, mixed_integration=False)
        scene = Scene(problem, fem.ModalLoads(newton.linear_solver, n_modes=1, young=young), newton)
        newtons = young * scene.force_unit * fixtures.end_traction(problem, 20.0)
        given = scene.load_of(newtons[None], torch.tensor([young], dtype=torch.float64))
        state = auditor.solve(newton, problem, given)
        if not state.stable.all():
            failures.append(f"E = {young:g} Pa, side {side:g} m: {describe(state)}")
            continue
        counts.append(int(state.iterations))
        metres = scene.length * state.displacement[0, int(problem.points.sum(dim=1).argmax())]
        for k, known in enumerate(printed):
            name = f"E = {young:g} Pa, L = {4 * side:g} m: u_{'xyz'[k]}/L"
            rows.append(Row(name, known, float(metres[k]) / (4 * side), 1e-9))
    if len(set(counts)) > 1:
        failures.append("iterations differ")
    return classify(f"iterations {', '.join(map(str, counts))}", rows, failures=failures)


def volumetric_locking(name: str, auditor: Auditor) -> Outcome:
    """Measure the volumetric locking of an element and whether `Problem.build` warns of it."""
    cells, cell, degree, printed = LOCKING[name]
    mean, rows = "mean" in name, list[Row]()
    for k, nu in enumerate(POISSON):
        with warnings.catch_warnings(record=True, action="always") as caught:
            ratio = compliance(nu, cells, cell, degree, mean) / REFERENCE(nu)
        said = any("lock at Poisson's ratio" in str(w.message) for w in caught)
        locks = nu >= 0.45 if degree == 1 else nu > 0.48 and cell == "tetra"
        due = locks and not mean
        if said != due:
            rows.append(Row(f"nu = {nu:g}: warnings of locking", str(int(due)), float(said), 0))
        if printed:
            rows.append(Row(f"nu = {nu:g}: compliance ratio", printed.split()[k], ratio))
        else:
            rows.append(Row(f"nu = {nu:g}: compliance ratio", "> 0.94", ratio))
            # above one where the reference itself locks
            most = {1: "< 1.02", 2: "< 1.06" if cell == "tetra" else "< 1.03"}[degree]
            rows.append(Row(f"nu = {nu:g}: compliance ratio", most, ratio))
    shown = " ".join(f"{row.value:.3f}" for row in rows if "ratio" in row.quantity)
    return classify(f"{shown}, warned of where due", rows)


def plate_bending(cells: tuple[int, int, int], auditor: Auditor) -> Outcome:
    """Bend a clamped plate, thin and thick."""
    rows = [
        Row(f"a/h = {slenderness}: w over Kirchhoff's", printed, _plate(cells, slenderness))
        for slenderness, printed in zip((100, 10), PLATE_DEFLECTIONS[cells], strict=True)
    ]
    return classify(", ".join(f"{row.value:.3f}" for row in rows), rows)


def _plate(cells: tuple[int, int, int], slenderness: int) -> float:
    problem, force, known = fixtures.plate(*cells, slenderness)
    answer = fem.solve(fem.LinearSolver(problem), as_load(force))
    below = fixtures.nearest_node(problem, [0.5, 0.5, 0.0])
    return -answer.displacement[0, below, 2].item() / known


def very_thin_plate(auditor: Auditor) -> Outcome:
    """Bend a plate of a/h = 1000: linear cells warn, quadratic cells agree with theory."""
    with warnings.catch_warnings(record=True, action="always") as caught:
        linear = _plate((16, 1, 1), 1000)
    said = [str(w.message) for w in caught if "lock in bending" in str(w.message)]
    quadratic = _plate((16, 1, 2), 1000)
    rows = [
        Row("linear cells: warnings of locking", "1", float(len(said)), 0),
        Row("w over Kirchhoff's, degree 2", "> 0.8", quadratic),
        Row("w over Kirchhoff's, degree 2", "< 1.01", quadratic),
    ]
    return classify(f"degree 1 {linear:.4f}, warned of; degree 2 {quadratic:.3f}", rows)


def long_cells(auditor: Auditor) -> Outcome:
    """Pull rods of cells with growing aspect ratio to a stretch of 1.5."""
    rows, failures = [], []
    for aspect in ASPECTS:
        mesh = fem.box([1.0, 1 / aspect, 1 / aspect], [3, 3, 3])
        problem = fem.Problem.build(mesh, NH, fixed=mesh.p.T == 0, length=1.0)
        force = fem.Traction(fem.Plane(0, "max"), [0.37828018, 0.0, 0.0]).on(problem)
        for name, newton in newton_variants(problem):
            state = auditor.solve(newton, problem, as_load(force))
            if not state.stable.all():
                failures.append(f"1:{aspect:g}, {name}: {describe(state)}")
                continue
            longest = 1 + float(state.displacement[..., 0].max())
            rows.append(Row(f"1:{aspect:g}, {name}: stretch", "1.5", longest, 1e-7))
            thinner = 1 + aspect * float(state.displacement[..., 1].min())
            rows.append(Row(f"1:{aspect:g}, {name}: lateral", ".88017459", thinner, 1e-7))
    return classify("stretches to 1e-7", rows, failures=failures)


def sliver(part: float, auditor: Auditor) -> Outcome:
    """Bend a beam with a layer of slivers with every direct backend."""
    rows, failures, worst = [], [], 0.0
    mesh = fem.box([100.0, 25.0, 25.0], [9, 3, 3])
    points = mesh.p.copy()
    points[0, points[0] == 50.0] = 37.5 + 12.5 * part
    mesh = replace(mesh, doflocs=points)
    with warnings.catch_warnings(record=True, action="always") as caught:
        problem = fem.Problem.build(mesh, SVK, fixed=fem.Plane(0, "min"))
    said = any("aspect ratio" in str(w.message) for w in caught)
    rows.append(Row("warnings of aspect ratio", "1", float(said), 0))
    end = int(problem.points.sum(dim=1).argmax())
    for name in DIRECT:
        for kind, newton in newton_variants(problem):
            solver = replace(newton, linear=name)
            with warnings.catch_warnings(record=True, action="always") as caught:
                state = auditor.solve(
                    solver, problem, as_load(fixtures.end_traction(problem, 20.0))
                )
            ratio = float(state.residual)
            worst = max(worst, ratio)
            if not state.stable.all():
                failures.append(f"{name}, {kind}: {describe(state)}")
                continue
            value = float(state.displacement[0, end, 2])
            rows.append(Row(f"{name}, {kind}: u_z/L", SLIVER_DEFLECTIONS[part], value))
            if ratio >= 1e-8:
                said = any("rounding allows no less" in str(w.message) for w in caught)
                rows.append(Row(f"{name}, {kind}: warnings of rounding", "1", float(said), 0))
    return classify(
        f"{', '.join(DIRECT)}: largest |R|/|f| {worst:.0e}, warned of", rows, failures=failures
    )


def cases() -> list[Case]:
    """Return the cases of this module."""
    same = "u/L to 1e-9 of the printed one, the same iterations"
    found = []
    for name, law, corner in REFERENCE_CORNER:
        run = partial(unit_systems, law, corner)
        found.append(Case("T7", f"{name}, E 1 to 1e12 Pa, L 4 mm to 4 km", same, run))
    for name, (*_, printed) in LOCKING.items():
        wanted = "as printed" if printed else "0.94 or more"
        expected = f"compliance over hex27's {wanted}; warned of where it locks"
        run = partial(volumetric_locking, name)
        found.append(Case("T8", f"{name}, nu .3 to .4999", expected, run))
    for cells, deflections in PLATE_DEFLECTIONS.items():
        description = f"clamped plate, {cells[0]} x {cells[0]} x {cells[1]} of degree {cells[2]}"
        expected = f"w over Kirchhoff's {deflections[0]} (a/h = 100) and {deflections[1]} (10)"
        found.append(Case("T10", description, expected, partial(plate_bending, cells)))
    expected = "linear cells warned of; quadratic ones within 0.8 to 1.01 of Kirchhoff's"
    found.append(Case("T10", "clamped plate, a/h = 1000", expected, very_thin_plate))
    expected = "stretch 1.5 and lateral .88017459, each to 1e-7"
    found.append(Case("T11", "rod of cells of aspect ratio 1 to 1:1000", expected, long_cells))
    for part, printed in SLIVER_DEFLECTIONS.items():
        expected = f"u_z/L = {printed}; a warning, not a failure"
        found.append(Case("T11", f"sliver layer of {part:g}", expected, partial(sliver, part)))
    return found

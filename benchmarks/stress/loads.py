"""Loads from 1e-9 to 25 times the training range: T1 to T6 and load sweeps."""

import math
from collections.abc import Callable, Iterator
from functools import partial

import torch

from benchmarks.stress.auditor import Auditor
from benchmarks.stress.case import Case, LoadLevel, Outcome, classify
from benchmarks.stress.fixtures import ELEMENTS, MAX_TRACTION, as_load, coarse_beam, end_traction
from benchmarks.verification.bodies import NAMES, mean, paper_beam, slender
from benchmarks.verification.report import Row
from benchmarks.verification.uniaxial import LAWS
from dpl import Scene, fem
from dpl.data.solving.solve import LoadKey, solve_load

SVK, NH = fem.SaintVenantKirchhoff(0.3), fem.NeoHookeanLn(0.3)
CELLS = (16, 4, 4)
# case, law, q [Pa], min J, smallest nodal u_z / L
LARGE: list[tuple[str, fem.Material, float, str, str]] = [
    ("T1", SVK, 80.0, ".720", ""),
    ("T3", NH, 80.0, ".804", "-.7239"),
    ("T4", NH, 160.0, ".723", "-.9179"),
    ("T4", NH, 400.0, ".590", "-1.1102"),
    ("T4", NH, 1000.0, ".443", "-1.3502"),
]
TOO_LARGE = (160.0, 400.0, 1000.0)  # T2: q [Pa] of SVK beyond the last valid equilibrium
SMALL = (1e-2, 1e-4, 1e-6)  # T6: q [Pa]
# over the largest load of the training range
AMPLITUDES = (1e-9, 1e-6, 1e-3, 0.1, 1.0, 4.0, 10.0, 25.0)


def newton_variants(problem: fem.Problem) -> Iterator[tuple[str, fem.Newton]]:
    """Yield Newton without and, where the law supports them, with mixed integration points."""
    for mixed in (False, True) if problem.material.has_response else (False,):
        yield ("mixed" if mixed else "plain"), fem.Newton(problem, mixed_integration=mixed)


def describe(state: fem.Solution) -> str:
    """Return status, iterations, residual and min det F of a solution as text."""
    said = f"{fem.Status(int(state.status))} in {int(state.iterations)} iterations"
    return f"{said}, |R|/|f| {float(state.residual):.0e}, min J {float(state.volume_ratio):.3f}"


def large_load(law: fem.Material, q: float, volume: str, deepest: str, auditor: Auditor) -> Outcome:
    """Solve a large load that has a solution."""
    problem, rows, failures, messages = paper_beam(law, CELLS), [], [], []
    for name, newton in newton_variants(problem):
        state = auditor.solve(newton, problem, as_load(end_traction(problem, q)))
        messages.append(f"{name}: {describe(state)}")
        if not state.stable.all() or int(state.negative_pivots):
            failures.append(f"{name} has no stable answer")
            continue
        rows.append(Row(f"{name}: min J", volume, float(state.volume_ratio)))
        if deepest:
            lowest = float(state.displacement[..., 2].min())
            rows.append(Row(f"{name}: min u_z/L", deepest, lowest))
    return classify("; ".join(messages), rows, failures=failures)


def load_without_equilibrium(q: float, auditor: Auditor) -> Outcome:
    """Solve a load without a valid equilibrium."""
    problem, messages, rows, failures = paper_beam(SVK, CELLS), [], [], []
    for name, newton in newton_variants(problem):
        state = auditor.solve(newton, problem, as_load(end_traction(problem, q)))
        part = q * float(state.load_factor)
        messages.append(
            f"{name}: {fem.Status(int(state.status))}, answered up to q = {part:.1f} Pa"
        )
        rows.append(Row(f"{name}: converged", "< 0.5", float(state.converged)))
        if state.status != fem.Status.NO_VALID_EQUILIBRIUM or not 130 < part < q:
            failures.append(f"{name}: not the status, or not the part of the load")
    return classify("; ".join(messages), rows, failures=failures)


def data_of_large_loads(auditor: Auditor) -> Outcome:
    """Generate samples of loads up to 25 times the usual ones and evaluate accepted ones again."""
    problem = paper_beam(SVK, (8, 2, 2))
    newton = fem.Newton(problem)
    scene = Scene(
        problem, fem.ModalLoads(newton.linear_solver, n_modes=3, deflection=25 * 0.4), newton
    )
    rows, accepted = list[Row](), 0
    for number in range(8):
        made = solve_load(scene, LoadKey((0, 0), number))
        u = torch.from_numpy(made.displacement)[None]
        sound = fem.evaluate_solution(problem, u, as_load(torch.from_numpy(made.force)), newton.tol)
        kept = f"load {number}"
        if made.accepted:
            accepted += 1
            rows.append(Row(f"{kept}: ||R|| / ||f||", "< 1e-8", float(sound.residual)))
            rows.append(Row(f"{kept}: min J", "> 0", float(sound.volume_ratio)))
            rows.append(Row(f"{kept}: pivots", "0", float(newton.stability(u)), 0))
        else:
            rows.append(Row(f"{kept}: rejected, and why", "1", float(bool(made.reason)), 0))
    return classify(f"{accepted} of 8 accepted, the others rejected with their reason", rows)


def slender_beam(auditor: Auditor) -> Outcome:
    """Bend a slender beam by the whole load in one step."""
    problem = slender(fem.NeoHookeanLn(0.0), (20, 1, 1))
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -1 / 12 / 400]).on(problem)
    messages, rows, failures = [], [], []
    for name, newton in newton_variants(problem):
        states = list(auditor.wrap(newton, problem, newton.tol).iterate(as_load(force)))
        if not states[-1].stable.all():
            failures.append(f"{name}: {describe(states[-1])}")
            continue
        parts = {float(state.load_factor) for state in states} - {0.0, 1.0}
        messages.append(
            f"{name}: {int(states[-1].iterations)} iterations, {len(parts)} parts of load"
        )
        tip = -mean(states[-1].displacement[0, :, 2], force[:, 2])
        rows.append(Row(f"{name}: w/L", ".302130893", tip))
    return classify("; ".join(messages), rows, failures=failures)


def small_loads(name: str, auditor: Auditor) -> Outcome:
    """Solve very small loads and the zero load."""
    problem, rows, failures = paper_beam(LAWS[name], (8, 2, 2)), [], []
    corner, most = int(problem.points.sum(dim=1).argmax()), 0
    for q in (*SMALL, 1e-12):
        load = as_load(end_traction(problem, q))
        state = auditor.solve(fem.Newton(problem), problem, load)
        most = max(most, int(state.iterations))
        if not state.stable.all():
            failures.append(f"q = {q:g}: {describe(state)}")
            continue
        linear = fem.solve(fem.LinearSolver(problem), load).displacement[0, corner, 2]
        ratio = float(state.displacement[0, corner, 2] / linear)
        rows.append(Row(f"q = {q:g} Pa: u_z over the linear one", "1", ratio, max(1e-2 * q, 1e-6)))
    none = auditor.solve(fem.Newton(problem), problem, as_load(0 * end_traction(problem, 1.0)))
    rows.append(Row("no load: |u|/L", "0", float(none.displacement.abs().max())))
    rows.append(Row("no load: iterations", "0", float(none.iterations)))
    return classify(f"linear within 1e-6, at most {most} iterations", rows, failures=failures)


def load_sweep(series: str, build: Callable[[], fem.Problem], auditor: Auditor) -> Outcome:
    """Solve loads of growing amplitude."""
    problem = build()
    unit, newton = end_traction(problem, MAX_TRACTION), fem.Newton(problem)
    levels, failures, rows = [], [], []
    for amplitude in AMPLITUDES:
        load = as_load(amplitude * unit)
        states = list(auditor.wrap(newton, problem, newton.tol).iterate(load))
        state, min_detF = states[-1], min(float(one.volume_ratio) for one in states)
        levels.append(level(series, amplitude, state, min_detF))
        if amplitude <= 1 and not state.converged.all():
            failures.append(f"{amplitude:g} of the range: {describe(state)}")
        if amplitude <= 1e-3 and state.converged.all():
            linear = fem.solve(fem.LinearSolver(problem), load).displacement
            apart = float((state.displacement - linear).norm() / linear.norm())
            bound = f"< {max(amplitude, 1e-6)}"
            rows.append(Row(f"{series}, {amplitude:g}: off linear", bound, apart))
    beyond = [f"{r.amplitude:g}: {r.status} ({r.iterations})" for r in levels if r.amplitude > 1]
    return classify("in range all; " + ", ".join(beyond), rows, failures=failures, levels=levels)


def level(
    series: str, amplitude: float, state: fem.Solution, min_detF: float, error: float = math.nan
) -> LoadLevel:
    """Return a load of a sweep with its solution, see `LoadLevel`."""
    status, iterations = str(fem.Status(int(state.status))), int(state.iterations)
    return LoadLevel(series, amplitude, float(state.residual), min_detF, iterations, status, error)


def cases() -> list[Case]:
    """Return the cases of this module."""
    whole = "the answer to the whole load, stable, min J and deflection as printed"
    expect_error = "no valid equilibrium, with the part of the load that has one; not stored"
    found = []
    for name, law, q, volume, deepest in LARGE:
        run = partial(large_load, law, q, volume, deepest)
        title = "SVK" if law is SVK else "NH-ln"
        found.append(Case(name, f"{title}, hex8 16 x 4 x 4, q = {q:g} Pa at once", whole, run))
    for q in TOO_LARGE:
        run = partial(load_without_equilibrium, q)
        found.append(Case("T2", f"SVK, hex8 16 x 4 x 4, q = {q:g} Pa", expect_error, run))
    kept = "accepted ones balanced, uninverted, stable; the others rejected with a reason"
    description = "data of SVK, loads up to 25 times the usual ones"
    found.append(Case("T2", description, kept, data_of_large_loads))
    bent_beam = "w/L = .302130893; plain Newton takes load steps for it"
    found.append(Case("T5", "slender beam 20 x 1 x 1, NH-ln, PL^2/EI = 1", bent_beam, slender_beam))
    small = "u/q of the linear solution to 1e-6; no load: rest, 0 iterations"
    found += [
        Case("T6", f"{name}, q = 1e-2 to 1e-12 Pa, and none", small, partial(small_loads, name))
        for name in LAWS
    ]
    sweep = "answers in range; beyond, an answer or a status; det F > 0 throughout"
    span = "1e-9 to 25 times the range"
    for name, law in LAWS.items():
        build = partial(coarse_beam, "hexahedron", 1, law)
        run = partial(load_sweep, f"{name}, hex8", build)
        found.append(Case("sweep", f"{name}, hex8 8 x 2 x 2, {span}", sweep, run))
    for cell, degree in ELEMENTS:
        if (cell, degree) == ("hexahedron", 1):
            continue  # it is there already, with all laws
        name = NAMES.get((cell, degree), f"{cell} of degree {degree}")
        run = partial(load_sweep, f"NH-ln, {name}", partial(coarse_beam, cell, degree, NH))
        found.append(Case("sweep", f"NH-ln, {name}, {span}", sweep, run))
    return sorted(found, key=lambda case: (case.name == "sweep", case.name))

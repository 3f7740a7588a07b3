"""Loads from 1e-9 of the training range to 25 times it: T1 to T6, and ladders."""

import math
from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from benchmarks.stress.auditor import Auditor
from benchmarks.stress.case import Case, LoadLevel, Outcome, classify
from benchmarks.stress.fixtures import KINDS, LARGEST, beam_of, load_of, pulled
from benchmarks.verification.bodies import NAMES, mean, paper_beam, slender
from benchmarks.verification.report import Row
from benchmarks.verification.uniaxial import LAWS
from dpl import Scene
from dpl.data.solving.solve import LoadKey, solve_load
from dpl.fem import (
    LinearSolver,
    Material,
    ModalLoads,
    NeoHookeanLn,
    Newton,
    Plane,
    Problem,
    SaintVenantKirchhoff,
    Solution,
    Status,
    Traction,
    evaluate_solution,
    solve,
)

SVK, NH = SaintVenantKirchhoff(0.3), NeoHookeanLn(0.3)
CELLS = (16, 4, 4)
# VERIFICATION 2.2: law, q [Pa], min J, min u_z / L of any node
ANSWERED: list[tuple[str, Material, float, str, str]] = [
    ("T1", SVK, 80.0, ".720", ""),
    ("T3", NH, 80.0, ".804", "-.7239"),
    ("T4", NH, 160.0, ".723", "-.9179"),
    ("T4", NH, 400.0, ".590", "-1.1102"),
    ("T4", NH, 1000.0, ".443", "-1.3502"),
]
HOPELESS = (160.0, 400.0, 1000.0)  # T2: q [Pa] of SVK beyond all valid answers
TINY = (1e-2, 1e-4, 1e-6)  # T6: q [Pa]
LADDER = (1e-9, 1e-6, 1e-3, 0.1, 1.0, 4.0, 10.0, 25.0)  # times the largest load of the training


def kinds(problem: Problem) -> Iterator[tuple[str, Newton]]:
    """Yield Newton without and with mixed integration points, where that differs."""
    for mixed in (False, True) if problem.supports_mip else (False,):
        yield ("mixed" if mixed else "plain"), Newton(problem, mixed_integration=mixed)


def words(state: Solution) -> str:
    """Return what one answer says of itself."""
    said = f"{Status(int(state.status))} in {int(state.iterations)} iterations"
    return f"{said}, |R|/|f| {float(state.residual):.0e}, min J {float(state.volume_ratio):.3f}"


def answered(law: Material, q: float, volume: str, deepest: str, watch: Auditor) -> Outcome:
    """Ask for a load that has an answer, whole."""
    problem, rows, fails, told = paper_beam(law, CELLS), [], [], []
    for name, newton in kinds(problem):
        state = watch.solve(newton, problem, load_of(pulled(problem, q)))
        told.append(f"{name}: {words(state)}")
        if not state.stable.all() or int(state.negative_pivots):
            fails.append(f"{name} has no stable answer")
            continue
        rows.append(Row(f"{name}: min J", volume, float(state.volume_ratio)))
        if deepest:
            lowest = float(state.displacement[..., 2].min())
            rows.append(Row(f"{name}: min u_z/L", deepest, lowest))
    return classify("; ".join(told), rows, fails=fails)


def hopeless(q: float, watch: Auditor) -> Outcome:
    """Ask for a load that has no valid answer."""
    problem, told, rows, fails = paper_beam(SVK, CELLS), [], [], []
    for name, newton in kinds(problem):
        state = watch.solve(newton, problem, load_of(pulled(problem, q)))
        part = q * float(state.load_factor)
        told.append(f"{name}: {Status(int(state.status))}, answered up to q = {part:.1f} Pa")
        rows.append(Row(f"{name}: converged", "< 0.5", float(state.converged)))
        if state.status != Status.NO_VALID_EQUILIBRIUM or not 130 < part < q:
            fails.append(f"{name}: not the status, or not the part of the load")
    return classify("; ".join(told), rows, fails=fails)


def stored(watch: Auditor) -> Outcome:
    """Make data of loads up to 25 times the usual ones: what is accepted is evaluated again."""
    problem = paper_beam(SVK, (8, 2, 2))
    newton = Newton(problem)
    scene = Scene(problem, ModalLoads(newton.linear_solver, n_modes=3, deflection=25 * 0.4), newton)
    rows, accepted = list[Row](), 0
    for number in range(8):
        made = solve_load(scene, LoadKey((0, 0), number))
        u = torch.from_numpy(made.displacement)[None]
        sound = evaluate_solution(problem, u, load_of(torch.from_numpy(made.force)), newton.tol)
        kept = f"load {number}"
        if made.accepted:
            accepted += 1
            rows.append(Row(f"{kept}: ||R|| / ||f||", "< 1e-8", float(sound.residual)))
            rows.append(Row(f"{kept}: min J", "> 0", float(sound.volume_ratio)))
            rows.append(Row(f"{kept}: pivots", "0", float(newton.negative_pivots(u)), 0))
        else:
            rows.append(Row(f"{kept}: rejected, and why", "1", float(bool(made.reason)), 0))
    return classify(f"{accepted} of 8 accepted, the others rejected with their reason", rows)


def slender_beam(watch: Auditor) -> Outcome:
    """Bend a slender beam by the whole load at once."""
    problem = slender(NeoHookeanLn(0.0), (20, 1, 1))
    force = Traction(Plane(0, "max"), [0.0, 0.0, -1 / 12 / 400]).on(problem)
    told, rows, fails = [], [], []
    for name, newton in kinds(problem):
        states = list(watch.over(newton, problem, newton.tol).iterate(load_of(force)))
        if not states[-1].stable.all():
            fails.append(f"{name}: {words(states[-1])}")
            continue
        parts = {float(state.load_factor) for state in states} - {0.0, 1.0}
        told.append(f"{name}: {int(states[-1].iterations)} iterations, {len(parts)} parts of load")
        tip = -mean(states[-1].displacement[0, :, 2], force[:, 2])
        rows.append(Row(f"{name}: w/L", ".302130893", tip))
    return classify("; ".join(told), rows, fails=fails)


def tiny(name: str, watch: Auditor) -> Outcome:
    """Ask for loads near nothing, and for none."""
    problem, rows, fails = paper_beam(LAWS[name], (8, 2, 2)), [], []
    corner, most = int(problem.points.sum(dim=1).argmax()), 0
    for q in (*TINY, 1e-12):
        load = load_of(pulled(problem, q))
        state = watch.solve(Newton(problem), problem, load)
        most = max(most, int(state.iterations))
        if not state.stable.all():
            fails.append(f"q = {q:g}: {words(state)}")
            continue
        linear = solve(LinearSolver(problem), load).displacement[0, corner, 2]
        ratio = float(state.displacement[0, corner, 2] / linear)
        rows.append(Row(f"q = {q:g} Pa: u_z over the linear one", "1", ratio, max(1e-2 * q, 1e-6)))
    none = watch.solve(Newton(problem), problem, load_of(0 * pulled(problem, 1.0)))
    rows.append(Row("no load: |u|/L", "0", float(none.displacement.abs().max())))
    rows.append(Row("no load: iterations", "0", float(none.iterations)))
    return classify(f"linear within 1e-6, at most {most} iterations", rows, fails=fails)


def climbed(series: str, build: Callable[[], Problem], watch: Auditor) -> Outcome:
    """Climb a ladder of loads."""
    problem = build()
    unit, newton = pulled(problem, LARGEST), Newton(problem)
    rungs, fails, rows = [], [], []
    for amplitude in LADDER:
        state, smallest = _climbed(watch, newton, amplitude * unit)
        rungs.append(rung(series, amplitude, state, smallest))
        if amplitude <= 1 and not state.converged.all():
            fails.append(f"{amplitude:g} of the range: {words(state)}")
        if amplitude <= 1e-3 and state.converged.all():
            linear = solve(LinearSolver(problem), load_of(amplitude * unit)).displacement
            apart = float((state.displacement - linear).norm() / linear.norm())
            rows.append(
                Row(f"{series}, {amplitude:g}: off linear", f"< {max(amplitude, 1e-6)}", apart)
            )
    beyond = [f"{r.amplitude:g}: {r.status} ({r.iterations})" for r in rungs if r.amplitude > 1]
    return classify("in range all; " + ", ".join(beyond), rows, fails=fails, rungs=rungs)


def rung(
    series: str, amplitude: float, state: Solution, smallest: float, error: float = math.nan
) -> LoadLevel:
    """Return one load of a ladder with its answer, see `LoadLevel`."""
    status, iterations = str(Status(int(state.status))), int(state.iterations)
    return LoadLevel(series, amplitude, float(state.residual), smallest, iterations, status, error)


def _climbed(watch: Auditor, newton: Newton, force: Tensor) -> tuple[Solution, float]:
    """Return the answer to a force and the smallest min det F on the way to it."""
    states = list(watch.over(newton, newton.problem, newton.tol).iterate(load_of(force)))
    return states[-1], min(float(state.volume_ratio) for state in states)


def cases() -> list[Case]:
    """Return the cases of this theme."""
    whole = "the answer to the whole load, stable, min J and deflection as printed"
    refused = "no valid equilibrium, with the part of the load that has one; not stored"
    found = [
        Case(
            name,
            f"{'SVK' if law is SVK else 'NH-ln'}, hex8 16 x 4 x 4, q = {q:g} Pa at once",
            whole,
            partial(answered, law, q, volume, deepest),
        )
        for name, law, q, volume, deepest in ANSWERED
    ]
    found += [
        Case("T2", f"SVK, hex8 16 x 4 x 4, q = {q:g} Pa", refused, partial(hopeless, q))
        for q in HOPELESS
    ]
    kept = "accepted ones balanced, uninverted, stable; the others rejected with a reason"
    found.append(Case("T2", "data of SVK, loads up to 25 times the usual ones", kept, stored))
    bent = "w/L = .302130893; plain Newton takes load steps for it"
    found.append(Case("T5", "slender beam 20 x 1 x 1, NH-ln, PL^2/EI = 1", bent, slender_beam))
    small = "u/q of the linear answer to 1e-6; no load: rest, 0 iterations"
    found += [
        Case("T6", f"{name}, q = 1e-2 to 1e-12 Pa, and none", small, partial(tiny, name))
        for name in LAWS
    ]
    ladder = "answers in range; beyond, an answer or a status; det F > 0 throughout"
    span = "1e-9 to 25 times the range"
    for name, law in LAWS.items():
        build = partial(beam_of, "hexahedron", 1, law)
        run = partial(climbed, f"{name}, hex8", build)
        found.append(Case("ladder", f"{name}, hex8 8 x 2 x 2, {span}", ladder, run))
    for cell, degree in KINDS:
        if (cell, degree) == ("hexahedron", 1):
            continue  # it is there already, with all laws
        name = NAMES.get((cell, degree), f"{cell} of degree {degree}")
        run = partial(climbed, f"NH-ln, {name}", partial(beam_of, cell, degree, NH))
        found.append(Case("ladder", f"NH-ln, {name}, {span}", ladder, run))
    return sorted(found, key=lambda case: (case.name == "ladder", case.name))

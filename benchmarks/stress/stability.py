"""Limit points, bifurcations and limits of laws: T17 and T22."""

import math
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from benchmarks.stress import fixtures
from benchmarks.stress.auditor import Auditor
from benchmarks.stress.case import Case, Outcome, classify
from benchmarks.stress.fixtures import as_load
from benchmarks.stress.loads import describe, newton_variants
from benchmarks.verification.report import Row
from benchmarks.verification.rods import BUCKLED
from dpl import fem

DIRECT = [name for name in fem.installed_backends() if name != "cg"]
SVK = fem.SaintVenantKirchhoff(0.0)
ANGLES = {2.5: 1.2, 4.0: 2.0}  # of the guess [rad] for each P [N] of `BUCKLED`
# Rivlin (1948): nu, equal stretch at which the cube loses its symmetry, T / E
RIVLIN = [(0.45, 1.083880948, ".7475041023"), (0.49, 1.013891353, ".6804639956")]
# P / E on a bar of NH-ln, stretch
BARRIER = [(-1, ".4835138104"), (-10, ".1073321638"), (1, "2.780359487"), (10, "26.00274671")]
SINGULAR = (2.0397, 2.039763, 2.0398, 2.5)  # P [N] about the critical load 2.039763


def straight_column(auditor: Auditor) -> Outcome:
    """Compress a straight column beyond its critical load."""
    problem, force = fixtures.column(SVK, (10, 1, 1))
    rows, failures = [], []
    for backend in DIRECT:
        for name, newton in newton_variants(problem):
            solver = replace(newton, linear=backend)
            state = auditor.solve(solver, problem, as_load(2.5 * force))
            if not state.converged.all():
                failures.append(f"{backend}, {name}: {describe(state)}")
                continue
            down = 10 * float(state.displacement[..., 0].min())
            rows += [
                Row(f"{backend}, {name}: u_x [m]", "-.02509", down),
                Row(f"{backend}, {name}: negative pivots", "2", float(state.negative_pivots)),
                Row(f"{backend}, {name}: status", "1", float(state.status), 0),
            ]
    return classify(
        f"unstable, 2 negative pivots, with {', '.join(DIRECT)}", rows, failures=failures
    )


def buckled_column(P: float, angle: float, printed: tuple[str, str], auditor: Auditor) -> Outcome:
    """Solve for both buckled equilibria from bent guesses."""
    problem, force = fixtures.column(SVK, (20, 2, 2))
    centre = fixtures.nearest_node(problem, [1.0, 0.05, 0.05])
    rows, failures = [], []
    for side in (1.0, -1.0):
        solver = fem.Newton(problem, tol=1e-10)
        audited = auditor.wrap(solver, problem, solver.tol)
        guess = fixtures.bent_column(problem, angle, side)
        *_, state = audited.iterate(as_load(P * force), guess=guess)
        if not state.stable.all():
            failures.append(f"side {side:+g}: {describe(state)}")
            continue
        end = state.displacement[0, centre]
        rows += [
            Row(f"side {side:+g}: w/L", printed[0], float(side * end[2])),
            Row(f"side {side:+g}: u/L", printed[1], -float(end[0])),
        ]
    return classify("both sides found, stable", rows, failures=failures)


def branch_switching(auditor: Auditor) -> Outcome:
    """Switch from an unstable equilibrium to the branches of the buckled column."""
    problem, force = fixtures.column(SVK, (10, 1, 1))
    solver, load = fem.Newton(problem), as_load(2.5 * force)
    state = auditor.solve(solver, problem, load)
    found = fem.post_buckling_branches(solver, load, state)
    centre = fixtures.nearest_node(problem, [1.0, 0.05, 0.05])
    failures, messages = [], []
    for side in found:
        auditor.check_iterate(problem, side)
        auditor.check_result(problem, load, side, solver.tol, solver.intermediate_tol)
        messages.append(str(fem.Status(int(side.status))))
        if not side.converged.all():
            failures.append(describe(side))
    left, right = (side.displacement[0, centre, 1:] for side in found)
    rows = [
        Row("mirror images: difference", "< 1e-6", float((left + right).norm() / left.norm())),
        Row("deflection/L", "> 0.1", float(left.norm())),
    ]
    return classify(
        f"deflection {float(left.norm()):.3f} L; {' and '.join(messages)}", rows, failures=failures
    )


def singular_tangent(auditor: Auditor) -> Outcome:
    """Compress a column by loads about the critical one with every backend."""
    problem, force = fixtures.column(SVK, (10, 1, 1))
    rows, failures, messages = [], [], []
    for backend in fem.installed_backends():
        ended = []
        for P in SINGULAR:
            solver = fem.Newton(problem, linear=backend)
            states = list(auditor.wrap(solver, problem, 1e-8).iterate(as_load(P * force)))
            ended.append(str(fem.Status(int(states[-1].status))))
            sound = all(bool(value.isfinite().all()) for state in states for value in state)
            rows.append(Row(f"{backend}, P = {P}: all finite", "1", float(sound), 0))
            definite = backend not in DIRECT  # conjugate gradients want a positive definite tangent
            if not definite and not states[-1].converged.all():
                failures.append(f"{backend}, P = {P}: {describe(states[-1])}")
        messages.append(f"{backend}: {', '.join(dict.fromkeys(ended))}")
    return classify("; ".join(messages), rows, failures=failures)


def _with_small_steps(problem: fem.Problem) -> fem.Newton:
    """Return Newton's method that follows the equilibria up to a limit point."""
    limits: dict[str, Any] = {"min_load_step": 2.0**-17, "max_total_iter": 2000}
    return fem.Newton(problem, linear="superlu", intermediate_tol=1e-9, **limits)


def limit_point(auditor: Auditor) -> Outcome:
    """Pull Yeoh's rubber beyond its limit point, from rest and from a guess beyond it."""
    problem, unit = fixtures.cube(fixtures.RUBBER)
    solver = _with_small_steps(problem)
    load = as_load(0.57 * unit)
    *_, state = auditor.wrap(solver, problem, solver.tol, solver.intermediate_tol).iterate(load)
    part = 0.57 * float(state.load_factor)
    rows = [
        Row("from rest: converged", "< 0.5", float(state.converged)),
        Row("from rest: P of the last answer", ".5696673896", part, 3.5e-5),
    ]
    beyond = fem.Newton(problem, tol=1e-10, linear="superlu")
    *_, snapped = auditor.wrap(beyond, problem, beyond.tol).iterate(
        load, guess=fixtures.uniaxial_stretch(problem, 2.8)
    )
    failures = [] if snapped.stable.all() else [describe(snapped)]
    if not failures:
        stretch = 1 + float(snapped.displacement[..., 0].max())
        rows.append(Row("beyond the gap: stretch", "2.836546", stretch, 2e-6))
    messages = f"{fem.Status(int(state.status))}, answered up to P = {part:.5f}"
    return classify(f"{messages}; beyond: stretch as printed", rows, failures=failures)


def compressive_collapse(auditor: Auditor) -> Outcome:
    """Compress a bar of SVK beyond its limit load; its mirror image is no valid solution."""
    law = fem.SaintVenantKirchhoff(0.3)
    problem, unit = fixtures.cube(law, 2)
    solver = _with_small_steps(problem)
    *_, state = auditor.wrap(solver, problem, solver.tol, solver.intermediate_tol).iterate(
        as_load(-0.2 * unit)
    )
    part, shortest = 0.2 * float(state.load_factor), 1 + float(state.displacement[..., 0].min())
    mirrored = (problem.points * torch.tensor([-2.0, 0.0, 0.0]))[None]
    rest = as_load(0 * unit)
    verdict = fem.evaluate_solution(problem, mirrored, rest, 1e-8)
    rows = [
        Row("converged", "< 0.5", float(state.converged)),
        Row("|P|/E of the last answer", ".1924500897", part, 5e-5),
        Row("stretch there, over 1/sqrt 3", "1", shortest * math.sqrt(3), 0.017),
        Row(
            "mirror image: |f_int|", "< 1e-15", float(problem.internal_force(mirrored).abs().max())
        ),
        Row("mirror image: min J", "-1", float(verdict.volume_ratio), 1e-9),
        Row("mirror image: converged", "< 0.5", float(verdict.converged)),
    ]
    messages = (
        f"{fem.Status(int(state.status))}, answered up to {part:.5f}; mirror image not accepted"
    )
    return classify(messages, rows)


def volumetric_barrier(auditor: Auditor) -> Outcome:
    """Compress and pull a bar of NH-ln, whose volumetric barrier carries any load."""
    problem, unit = fixtures.cube(fem.NeoHookeanLn(0.3), 2)
    rows, failures = [], []
    end = problem.points[:, 0] == 1
    for P, printed in BARRIER:
        for name, newton in newton_variants(problem):
            solver = replace(newton, tol=1e-11, linear="superlu")
            state = auditor.solve(solver, problem, as_load(P * unit), tol=1e-11)
            if not state.converged.all():
                failures.append(f"P = {P}, {name}: {describe(state)}")
                continue
            stretch = 1 + float(state.displacement[0, end, 0].mean())
            rows.append(Row(f"P/E = {P}, {name}: stretch", printed, stretch, 1e-8))
    return classify("stretches to 1e-8", rows, failures=failures)


def hydrostatic_pressure(auditor: Auditor) -> Outcome:
    """Compress a cube of NHiso-k2; its largest pressure is kappa s^2 (1 - s^3) at s^3 = 2/5."""
    law = fem.NeoHookeanIsoK2(0.3)
    problem, unit = fixtures.cube(law, 1, (0, 1, 2))
    limit, rows = float(law.bulk_modulus) * 0.4 ** (2 / 3) * 0.6, []
    for name, newton in newton_variants(problem):
        solver = replace(newton, linear="superlu")
        below = auditor.solve(solver, problem, as_load(-0.99 * limit * unit))
        above = auditor.solve(solver, problem, as_load(-1.02 * limit * unit))
        reached = 1.02 * float(above.load_factor)
        rows += [
            Row(f"{name}, 0.99 of the limit: converged", "1", float(below.converged)),
            Row(f"{name}, 1.02 of the limit: converged", "< 0.5", float(above.converged)),
            Row(f"{name}, part of the limit that is reached", "1", reached, 0.02),
        ]
    return classify(f"answered below, {fem.Status(int(above.status))} above", rows)


def rivlin_cube(nu: float, stretch: float, printed: str, auditor: Auditor) -> Outcome:
    """Load Rivlin's cube below and above the bifurcation of the symmetric state."""
    problem, unit = fixtures.cube(fem.NeoHookeanLn(nu), 1, (0, 1, 2))
    rows = [Row("T/E there", printed, fixtures.equitriaxial_stretch(problem, stretch)[1], 1e-7)]
    for part, pivots in ((0.99, "0"), (1.01, "2")):
        known, T = fixtures.equitriaxial_stretch(problem, 1 + part * (stretch - 1))
        solver = fem.Newton(problem, linear="superlu")
        state = auditor.solve(solver, problem, as_load(T * unit))
        off = float((state.displacement - known).abs().max())
        rows += [
            Row(f"{part}: negative pivots", pivots, float(state.negative_pivots)),
            Row(f"{part}: off the symmetric state", "< 1e-7", off),
        ]
    return classify("stable below, unstable above", rows)


def cases() -> list[Case]:
    """Return the cases of this module."""
    found = [
        (
            "column 10 x 1 x 1, SVK, P = 2.5 N, from rest",
            "balanced, tagged unstable with 2 negative pivots, u_x = -.02509 m",
            straight_column,
        )
    ]
    for P, printed in BUCKLED.items():
        description = f"column in hex27 20 x 2 x 2, P = {P} N, from bent guesses"
        expected = f"w/L = {printed[0]}, u/L = {printed[1]} to either side, stable"
        found.append((description, expected, partial(buckled_column, P, ANGLES[P], printed)))
    for nu, stretch, load in RIVLIN:
        expected = f"symmetry lost at T/E = {load}: tagged unstable above"
        run = partial(rivlin_cube, nu, stretch, load)
        found.append((f"Rivlin's cube, NH-ln, nu = {nu}", expected, run))
    found += [
        (
            "branch switching from an unstable column",
            "two answers, mirror images; each with its status (soft in two directions)",
            branch_switching,
        ),
        (
            "snap-through: cube of Yeoh's rubber, P = .57",
            "from rest refused at P = .5696673896; beyond the gap 2.836546",
            limit_point,
        ),
        (
            "collapse: bar of SVK, P = -.2 E; its mirror image",
            "refused at .1924500897 E; min J = -1 is no answer",
            compressive_collapse,
        ),
        ("bar of NH-ln, P = -10 to 10 E", "stretches as printed", volumetric_barrier),
        (
            "cube of NHiso-k2 under pressure",
            "answered below its largest pressure, refused above",
            hydrostatic_pressure,
        ),
    ]
    description = "singular tangent: column at P = 2.039763 N and about, every backend"
    expected = "an answer or a status, nothing that is not a number"
    singular = Case("T22", description, expected, singular_tangent)
    return [*(Case("T17", *case) for case in found), singular]

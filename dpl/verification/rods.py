"""Slender bodies far from rest: elastica, twisted column, buckling."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import brentq
from scipy.special import ellipeinc, ellipk, ellipkinc
from torch import Tensor

from dpl.fem.forces import Traction
from dpl.fem.linear import backend
from dpl.fem.materials import Material, NeoHookeanLn, SaintVenantKirchhoff
from dpl.fem.mesh import Plane, box
from dpl.fem.newton import Newton
from dpl.fem.problem import Problem
from dpl.fem.solution import Status
from dpl.fem.supports import Displacement
from dpl.verification.bodies import Array, balanced, lattice, mean, slender
from dpl.verification.drawing import COLOURS, measured, panel, picture, reference, side, solid
from dpl.verification.report import Row, Section


MATTIASSON = {  # P L^2 / EI: w / L, u / L of the tip
    **{"0.1": (".033295319", ".00066539996"), "0.2": (".066364482", ".0026465483")},
    **{"0.25": (".082745915", ".0041178184"), "0.5": (".16214358", ".015918962")},
    **{"0.75": (".23561523", ".033966315"), "1": (".30172077", ".056433236")},
    **{"1.5": (".41097821", ".1079415"), "2": (".49345748", ".16064172")},
    **{"3": (".60325344", ".25442018"), "4": (".66996418", ".32894124")},
    **{"5": (".71379152", ".38762836"), "6": (".74457115", ".43458883")},
    **{"7": (".7673691", ".47292743"), "8": (".78498237", ".50482773")},
    **{"9": (".79905553", ".53182056"), "10": (".81060902", ".5549956")},
}


def bent_line(tip: float, count: int = 200) -> tuple[float, Array]:
    """Return P L^2 / EI and the line (count, 2) of a clamped elastica under a dead load across.

    Source: Bisshopp, Drucker (1945), Quart. Appl. Math. 3.

    Args:
        tip: Slope at the tip, in (0, pi/2) [rad].
        count: Points of the line, from the clamp to the tip.
    """
    m = (1 + math.sin(tip)) / 2
    slopes = np.concatenate([[0.0], tip * np.sin(np.linspace(0, math.pi / 2, count))[1:]])
    angle = np.arcsin(np.sqrt(np.minimum((1 + np.sin(slopes)) / (2 * m), 1.0)))
    F, E = (
        ellipkinc(angle, m) - ellipkinc(angle[0], m),
        ellipeinc(angle, m) - ellipeinc(angle[0], m),
    )
    x = math.sqrt(2) * (math.sqrt(math.sin(tip)) - np.sqrt(np.abs(math.sin(tip) - np.sin(slopes))))
    return float(F[-1]) ** 2, np.stack([x, F - 2 * E], axis=1) / F[-1]


def _elastica_at(line: Callable[[float], Any], load: float, steepest: float) -> Any:
    """Return what a family of elasticas, by the slope at the tip, has at a load."""
    return line(brentq(lambda slope: line(slope)[0] - load, 1e-3, steepest, xtol=1e-13))


def elastica(folder: Path) -> Section:
    """Bend slender beams through large rotations."""
    kinds = {
        "hex27, 20 × 1 × 1": ((20, 1, 1), "hexahedron", 2),
        "tet10, 20 × 1 × 1": ((20, 1, 1), "tetra", 2),
        "hex8, 40 × 2 × 2": ((40, 2, 2), "hexahedron", 1),
        "tet4, 40 × 2 × 2": ((40, 2, 2), "tetra", 1),
    }
    loads = [float(alpha) for alpha in MATTIASSON]
    found, shapes = {}, {}
    for name, (cells, cell, degree) in kinds.items():
        problem = slender(SaintVenantKirchhoff(0.0), cells, cell, degree)
        newton = Newton(problem)
        unit = Traction(Plane(0, "max"), [0.0, 0.0, -1 / 12 / 400]).on(problem)
        tips = []
        for alpha in loads:
            u = balanced(newton, alpha * unit).displacement[0]
            shapes[name, alpha] = problem, u
            tips.append((-mean(u[:, 2], unit[:, 2]), -mean(u[:, 0], unit[:, 2])))
        found[name] = np.array(tips)
    rows = []
    for name in list(kinds)[:2]:
        for k, (alpha, (w, u)) in enumerate(MATTIASSON.items()):
            if alpha in ("0.1", "1", "4", "10"):
                rows += [Row(f"{name}, α = {alpha}: w/L", w, found[name][k, 0], 6e-3)]
                rows += [Row(f"{name}, α = {alpha}: u/L", u, found[name][k, 1], 6e-3)]
    one = loads.index(1.0)
    hex27 = found["hex27, 20 × 1 × 1"]
    for alpha, known in ((1.0, "0.30216"), (4.0, "0.67157"), (10.0, "0.81379")):
        what = f"hex27, α = {alpha:.0f}: w/L, independent code on this mesh"
        rows.append(Row(what, known, hex27[loads.index(alpha), 0]))
    known = float(MATTIASSON["1"][0])
    for name, printed in (("hex8, 40 × 2 × 2", "-9.3"), ("tet4, 40 × 2 × 2", "-41")):
        off = 100 * (found[name][one, 0] / known - 1)
        rows.append(Row(f"{name}, α = 1: error of w/L [%], independent code", printed, off))
    _draw_elastica(folder / "elastica.png", loads, found, shapes)
    return Section(
        "Elastica",
        "A clamped beam of length 20 and section 1 × 1 (SVK, ν = 0, E = 1200, so that EI = 100) "
        "under a dead tip load P across it, α = PL²/EI; displacements of the tip are averaged over "
        "the end section. References: the inextensible, shear-rigid elastica (Bisshopp, Drucker "
        "1945; Mattiasson 1981) by elliptic integrals. A body 20 times as long as thick is "
        "neither: quadratic elements must come within 0.6 %.",
        rows,
        [
            (
                "elastica.png",
                "(a) Deflection w and shortening u of the tip against the load: black line and "
                "circles elliptic integrals. (b) hex27 deformed, with the elastica's line.",
            )
        ],
        [
            "Linear elements lock in bending: with as many nodes, hex8 is "
            f"{100 * (1 - found['hex8, 40 × 2 × 2'][one, 0] / known):.0f} % too stiff at α = 1 and "
            f"tet4 {100 * (1 - found['tet4, 40 × 2 × 2'][one, 0] / known):.0f} %."
        ],
    )


def _draw_elastica(path: Path, loads: list[float], found: Any, shapes: Any) -> None:
    with picture(path, 3.3) as figure:
        ax = panel(figure, 1, "load α = PL²/EI [-]", "tip displacement / L [-]", "(a)")
        lines = [bent_line(tip) for tip in np.linspace(0.01, 1.475, 120)]
        alpha, ends = np.array([a for a, _ in lines]), np.array([line[-1] for _, line in lines])
        ax.plot(alpha, ends[:, 1], "k-", linewidth=0.8, label="elastica")
        ax.plot(alpha, 1 - ends[:, 0], "k-", linewidth=0.8)
        known = np.array([[float(w), float(u)] for w, u in MATTIASSON.values()])
        reference(ax, loads, known[:, 0])
        reference(ax, loads, known[:, 1], "its values")
        for k, (name, tips) in enumerate(found.items()):
            shown = slice(None, None, 1 if k != 1 else 2)
            style = {"linestyle": "none", "markersize": 3.5}
            measured(ax, loads[shown], tips[shown, 0], k, name, **style)
            measured(ax, loads[shown], tips[shown, 1], k, **style)
        ax.text(10.1, 0.84, "w/L", ha="right")
        ax.text(10.1, 0.585, "u/L", ha="right")
        ax.set(xlim=(-0.2, 10.4), ylim=(-0.02, 0.92))
        ax.legend(loc="upper left", bbox_to_anchor=(0.27, 0.44))
        ax = panel(figure, 2, "x/L [-]", "z/L [-]", "(b)", aspect="equal")
        ax.grid(False)
        for k, chosen in enumerate((0.5, 1.0, 2.0, 4.0, 10.0)):
            problem, u = shapes["hex27, 20 × 1 × 1", chosen]
            side(ax, problem, u, COLOURS[k], (0, 2))
            _, line = _elastica_at(bent_line, chosen, 1.57)
            ax.plot(line[:, 0], 0.025 - line[:, 1], "k-", linewidth=0.8)
            ax.annotate(
                f"α = {chosen:g}",
                (line[-1, 0], 0.025 - line[-1, 1]),
                (-3, -12),
                textcoords="offset points",
                ha="center",
            )
        ax.set(xlim=(-0.03, 1.08), ylim=(-0.95, 0.1))


TWIST = {  # cells, degree: torque [N m], axial force [N], energy [J]
    ((4, 4, 20), 1): ("18024.62786229", "-800.53818109", "14151.84978085"),
    ((2, 2, 10), 2): ("17404.618354", "-479.767061", "13664.649365"),
    ((4, 4, 20), 2): ("17150.398827", "-355.321678", "13462.158844"),
}
SAINT_VENANT = 0.140577  # torsion constant of the unit square [-]


def twisted(cells: Sequence[int], degree: int, angles: Sequence[float]) -> tuple[Array, Any]:
    """Return torque [N m], axial force [N] and energy [J] at angles, and the last shape."""
    young, mesh = 1e6, box([1.0, 1.0, 5.0], [n + 1 for n in cells])
    clamps = [Displacement(Plane(2, "min")), Displacement(Plane(2, "max"))]
    rest = Problem.build(mesh, NeoHookeanLn(0.3), supports=clamps, degree=degree)
    X = rest.points - torch.tensor([0.1, 0.1, 0.0], dtype=torch.float64)
    top, found, u = X[:, 2] > 1 - 1e-9, [], torch.zeros_like(X)
    for angle in angles:
        turn = angle * X[:, 2]
        c, s = turn.cos(), turn.sin()
        guess = torch.stack([c * X[:, 0] - s * X[:, 1], s * X[:, 0] + c * X[:, 1], X[:, 2]], 1) - X
        problem = replace(rest, prescribed=torch.where(rest.free, 0.0, guess))
        u = balanced(Newton(problem, tol=1e-11), guess=guess[None]).displacement
        f, x = problem.internal_force(u)[0, top], (X + u[0])[top]
        torque = (x[:, 0] * f[:, 1] - x[:, 1] * f[:, 0]).sum()
        energy = problem.energy(u)[0]
        found.append((torque * young * 125, f[:, 2].sum() * young * 25, energy * young * 125))
    return np.array(found), (rest, u[0])


def twist(folder: Path) -> Section:
    """Twist a column by a right angle."""
    degrees = np.arange(10.0, 91.0, 10.0)
    rows, found = [], {}
    for (cells, degree), printed in TWIST.items():
        name = f"hex{8 if degree == 1 else 27}, {' × '.join(map(str, cells))}"
        found[name], shape = twisted(cells, degree, np.radians(degrees).tolist())
        for what, known, value in zip(
            ("torque [N m]", "axial force [N]", "energy [J]"), printed, found[name][-1], strict=True
        ):
            rows.append(Row(f"{name}: {what}", known, float(value), 1e-8))
    with picture(folder / "twist.png", 3.3) as figure:
        panels = [
            panel(figure, 1, "angle [°]", "torque [kN m]", "(a)", columns=3),
            panel(figure, 2, "angle [°]", "axial force [N]", "(b)", columns=3),
        ]
        shear = 1e6 / 2.6 * SAINT_VENANT * np.radians([0, 90]) / 5e3
        panels[0].plot([0, 90], shear, "k--", linewidth=0.8, label="Saint-Venant, linear")
        for column, ax in enumerate(panels):
            for k, (name, values) in enumerate(found.items()):
                measured(ax, degrees, values[:, column] / (1, 1e3)[column == 0], k, name)
            known = [float(p[column]) / (1, 1e3)[column == 0] for p in TWIST.values()]
            reference(ax, [90] * 3, known, "independent code")
            ax.set_xticks([0, 30, 60, 90])
        panels[0].legend(loc="upper left")
        ax = figure.add_subplot(1, 3, 3, projection="3d")
        solid(ax, *shape, COLOURS[2])
        ax.set_title("(c) 90°", loc="left")
    return Section(
        "Twisted column",
        "A column 1 × 1 × 5 m (NH-ln, E = 1 MPa, ν = 0.3), clamped at its foot; the top is turned "
        "rigidly by 90° and does not move along the axis. The axial force is what holds it "
        "there: a second-order effect that no linear theory has. References: an independent "
        "code on the same meshes, to 1e-8.",
        rows,
        [("twist.png", "(a) Torque, (b) axial force on the top, (c) hex27 turned by 90°.")],
        [
            "The three meshes agree on the torque within "
            f"{100 * (rows[0].value / rows[6].value - 1):.0f} %, on the axial force not within a "
            f"factor of {rows[1].value / rows[7].value:.1f}: it is the difference of large stresses "
            "that the clamped ends concentrate at edges."
        ],
    )


POST = {"2.5": (".66363", ".34682"), "4": (".80022", ".90518")}  # P: w / L, u / L of the elastica


def buckled_line(slope: float, count: int = 200) -> tuple[float, Array, Array]:
    """Return P / P_cr, the line (count, 2) and its slopes (count,) of a buckled clamped elastica.

    Source: Timoshenko, Gere (1961), Theory of Elastic Stability, section 2.7.

    Args:
        slope: At the tip, in (0, pi) [rad].
        count: Points, at equal steps of length from the clamp to the tip.
    """
    k = math.sin(slope / 2)
    phase = np.linspace(0, math.pi / 2, 20 * count)
    F, E, K = ellipkinc(phase, k * k), ellipeinc(phase, k * k), float(ellipk(k * k))
    curve = np.stack([(2 * E - F) / K, 2 * k * (1 - np.cos(phase)) / K], axis=1)
    s = np.linspace(0, 1, count)
    line = np.stack([np.interp(s, F / K, c) for c in curve.T], axis=1)
    return (2 * K / math.pi) ** 2, line, np.interp(s, F / K, 2 * np.arcsin(k * np.sin(phase)))


def _straight(problem: Problem, unit: Tensor, tangents: Any, P: float) -> int:
    """Return the negative eigenvalues of the tangent of a column that is squeezed straight."""
    u = balanced(Newton(problem, tol=1e-10), P * unit).displacement
    return int(tangents.factorise(problem.linearise(u).tangent[0].numpy()).negative_pivots)


def critical(law: Material, cells: Sequence[int], across: float) -> float:
    """Return the load P [N] at which the tangent of a straight column becomes singular.

    Args:
        law: Of the column.
        cells: Along and across.
        across: P L^2 / EI per newton.
    """
    problem = slender(law, cells)
    unit = _end_force(problem, across)
    tangents, low, high = backend(problem.pattern, "superlu"), 2.0, 2.1
    while high - low > 2e-7:
        middle = (low + high) / 2
        low, high = (low, middle) if _straight(problem, unit, tangents, middle) else (middle, high)
    return (low + high) / 2


def _end_force(problem: Problem, alpha: float) -> Tensor:
    """Return the axial dead load (N, D) [-] of a given P L^2 / EI on a slender square beam."""
    thick = float(problem.points[:, 1].max())
    return Traction(Plane(0, "max"), [-alpha * thick**2 / 12, 0.0, 0.0]).on(problem)


def _bent(problem: Problem, line: Array, slopes: Array) -> Tensor:
    """Return the displacement (1, N, D) that brings a slender beam onto a line, sections rigid."""
    X, s = problem.points.numpy(), np.linspace(0, 1, len(slopes))
    x, z, slope = (np.interp(X[:, 0], s, values) for values in (*line.T, slopes))
    height = X[:, 2] - X[:, 2].mean()
    moved = [x - height * np.sin(slope), X[:, 1], X[:, 2].mean() + z + height * np.cos(slope)]
    return torch.from_numpy(np.stack(moved, axis=1) - X)[None]


EULER = math.pi**2 / 4  # P L^2 / EI at which a column, clamped below, free above, buckles
PER_NEWTON = 100 / (1000 / 12)  # P L^2 / EI of 1 N on a column 10 x 1 x 1, E = 1000 Pa


def buckling(folder: Path) -> Section:
    """Buckle columns, and tell the straight branch from the bent one."""
    svk, rows = SaintVenantKirchhoff(0.0), []
    for law, cells, known in (
        (svk, (10, 1, 1), "2.039763"),
        (svk, (20, 2, 2), "2.037811"),
        (NeoHookeanLn(0.0), (10, 1, 1), "2.056558"),
    ):
        name = f"{'SVK' if law is svk else 'NH-ln'}, hex27, {' × '.join(map(str, cells))}"
        value = critical(law, cells, PER_NEWTON)
        rows.append(Row(f"{name}: critical load [N]", known, value, 2e-6))
    value = critical(svk, (40, 1, 1), PER_NEWTON) * PER_NEWTON / EULER
    rows.append(Row("SVK, L/h = 40, hex27, 40 × 1 × 1: critical load / Euler's", "1", value, 2e-3))
    problem = slender(svk, (10, 1, 1))
    answer = balanced(Newton(problem), _end_force(problem, 2.5 * PER_NEWTON))
    shortening = 10 * float(answer.displacement[..., 0].min())
    rows += [
        Row("10 × 1 × 1, P = 2.5 N, from rest: u_x of the tip [m]", "-0.02509", shortening),
        Row("the same: negative pivots", "2", float(answer.negative_pivots)),
    ]
    loads = np.array([2.05, 2.06, 2.08, 2.12, 2.2, 2.35, 2.5, 2.75, 3.0, 3.25, 3.5, 3.75, 4.0])
    branches, shapes = {}, {}
    for slender, cells in ((10, (20, 2, 2)), (40, (40, 1, 1))):
        problem = slender(svk, cells)
        newton, weights = Newton(problem), _end_force(problem, 1.0)[:, 0]
        line = _elastica_at(buckled_line, 4 * PER_NEWTON / EULER, 3.0)
        guess, tips = _bent(problem, *line[1:]), []
        for P in loads[::-1].tolist():
            if slender == 40 and P * PER_NEWTON < 1.001 * EULER:
                continue  # not buckled yet
            answer = balanced(newton, _end_force(problem, P * PER_NEWTON), guess)
            guess = answer.displacement
            w, u = mean(guess[0, :, 2], weights), -mean(guess[0, :, 0], weights)
            tips.append((P, w, u, float(answer.status)))
            shapes[slender, P] = problem, guess[0]
        branches[slender] = np.array(tips)
    for P, w, u in (("2.5", ".6873", ".3885"), ("4", ".7925", ".9731")):
        tip = branches[10][branches[10][:, 0] == float(P)][0]
        rows.append(Row(f"L/h = 10, buckled, P = {P} N: w/L, independent code", w, tip[1]))
        rows.append(Row(f"L/h = 10, buckled, P = {P} N: u/L, independent code", u, tip[2]))
    for slender in (40, 10):
        for P, (w, u) in POST.items():
            tip = branches[slender][branches[slender][:, 0] == float(P)][0]
            rows.append(Row(f"L/h = {slender}, P = {P} N: w/L, elastica", w, tip[1], 0.01))
            rows.append(Row(f"L/h = {slender}, P = {P} N: u/L, elastica", u, tip[2], 0.01))
    problem = slender(svk, (20, 2, 2))
    straight = []
    for P in np.arange(0.5, 4.01, 0.25).tolist():
        answer = balanced(Newton(problem), _end_force(problem, P * PER_NEWTON))
        straight.append((P, float(answer.status), float(answer.negative_pivots)))
        shapes["straight", P] = problem, answer.displacement[0]
    _draw_buckling(folder / "buckling.png", np.array(straight), branches, shapes)
    unstable = sum(status == Status.UNSTABLE for _, status, _ in straight)
    above = sum(rows[1].value < P for P, *_ in straight)
    return Section(
        "Buckling",
        "A column 10 × 1 × 1 m (E = 1000 Pa, ν = 0, hex27), clamped below, under an axial dead load "
        "P above; Euler's critical load is 2.056168 N. Critical loads are where the tangent of the "
        "straight column becomes singular, by bisection on its negative pivots. The bent branch "
        "is reached by a guess, the elastica's shape at P = 4 N, and followed down. "
        "References: an independent code on the same meshes (critical loads to 2e-6); the "
        "elastica by elliptic integrals, to 1 %.",
        rows,
        [
            (
                "buckling.png",
                "(a) Deflection w of the tip: black the elastica, crosses what Newton finds from "
                "rest beyond the critical load and flags as unstable. (b) Both answers at the "
                "same loads, L/h = 10.",
            )
        ],
        [
            f"Newton from rest finds the straight column at every load. Of the {above} loads above "
            f"the critical one it flags {unstable} as *unstable* (negative pivots in the tangent): "
            "in balance, but no minimum of the energy. "
            f"All {sum(len(b) for b in branches.values())} answers on the bent branches are stable."
            if all((b[:, 3] == Status.CONVERGED).all() for b in branches.values())
            else "**Some answers on the bent branches are flagged unstable.**",
            "The values in bold are not errors of the solver: the column with L/h = 10 is shear-"
            "flexible and, under SVK, softer when compressed. Its critical load is lower by "
            f"{100 * (1 - rows[1].value / 2.056168):.1f} %, and just above it the deflection rises "
            "steeply with P/P_crit. The column with L/h = 40 meets the elastica.",
        ],
    )


def _draw_buckling(path: Path, straight: Array, branches: Any, shapes: Any) -> None:
    with picture(path, 3.3) as figure:
        ax = panel(figure, 1, "load P / Euler's critical load [-]", "deflection w/L [-]", "(a)")
        lines = [buckled_line(slope, 3) for slope in np.linspace(0.01, 2.55, 100)]
        known = np.array([(ratio, line[-1, 1]) for ratio, line, _ in lines])
        ax.plot(*known.T, "k-", linewidth=0.8, label="elastica")
        scale = PER_NEWTON / EULER
        reference(
            ax, [float(P) * scale for P in POST], [float(w) for w, _ in POST.values()], "its values"
        )
        for k, (slender, tips) in enumerate(branches.items()):
            measured(
                ax, tips[:, 0] * scale, tips[:, 1], k, f"bent, L/h = {slender}", linestyle="none"
            )
        good = straight[:, 1] == Status.CONVERGED
        measured(
            ax,
            straight[good, 0] * scale,
            0 * straight[good, 0],
            2,
            "straight, stable",
            linestyle="none",
        )
        bad = straight[~good]
        style = {"linestyle": "none", "marker": "x", "markersize": 4.5}
        measured(ax, bad[:, 0] * scale, 0 * bad[:, 0], 4, "straight, flagged unstable", **style)
        ax.set(xlim=(0, 2.02), ylim=(-0.05, 0.9))
        ax.legend(loc="upper left")
        ax = panel(figure, 2, "z/L [-]", "x/L [-]", "(b)", aspect="equal")
        ax.grid(False)
        for column, P in enumerate((2.5, 3.0, 4.0)):
            _, line, _ = _elastica_at(buckled_line, P * scale, 3.0)
            for k, name in ((4, "straight"), (0, 10)):
                problem, u = shapes[name, P]
                moved = u + torch.tensor([0.0, 0.0, 1.25 * column], dtype=u.dtype)
                side(ax, problem, moved, COLOURS[k], (2, 0))
            ax.plot(line[:, 1] + 0.05 + 1.25 * column, line[:, 0], "k-", linewidth=0.8)
            ax.text(0.05 + 1.25 * column, 1.06, f"P = {P:g} N", ha="center")
        ax.set(xlim=(-0.25, 3.55), ylim=(-0.3, 1.2))

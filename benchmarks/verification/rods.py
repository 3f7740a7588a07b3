"""Slender beams against the elastica: bending and buckling."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import brentq
from scipy.special import ellipeinc, ellipk, ellipkinc
from torch import Tensor

from benchmarks.study import picture
from benchmarks.verification.bodies import Array, balanced, lattice, mean, slender
from benchmarks.verification.drawing import curve, measured, panel, reference, side
from benchmarks.verification.report import Row, Section
from dpl import fem
from dpl.fem.linear import make_backend
from dpl.visualization import COLOURS

SVK = fem.SaintVenantKirchhoff(0.0)
BENT = {  # P L^2 / EI: w / L and u / L of the tip, by elliptic integrals
    0.1: (".033295319", ".00066539996"),
    0.2: (".066364482", ".0026465483"),
    0.25: (".082745915", ".0041178184"),
    0.5: (".16214358", ".015918962"),
    0.75: (".23561523", ".033966315"),
    1.0: (".30172077", ".056433236"),
    1.5: (".41097821", ".1079415"),
    2.0: (".49345748", ".16064172"),
    3.0: (".60325344", ".25442018"),
    4.0: (".66996418", ".32894124"),
    5.0: (".71379152", ".38762836"),
    6.0: (".74457115", ".43458883"),
    7.0: (".7673691", ".47292743"),
    8.0: (".78498237", ".50482773"),
    9.0: (".79905553", ".53182056"),
    10.0: (".81060902", ".5549956"),
}
KINDS = {
    "hex27, 20 × 1 × 1": ((20, 1, 1), "hexahedron", 2),
    "tet10, 20 × 1 × 1": ((20, 1, 1), "tetra", 2),
    "hex8, 40 × 2 × 2": ((40, 2, 2), "hexahedron", 1),
    "tet4, 40 × 2 × 2": ((40, 2, 2), "tetra", 1),
}
LOCKED = {"hex8, 40 × 2 × 2": "-9.3", "tet4, 40 × 2 × 2": "-41"}  # error of w / L at 1 [%]
SAME = {1.0: "0.30216", 4.0: "0.67157", 10.0: "0.81379"}  # w / L of hex27
Line = Callable[[float], tuple[float, Array, Array]]


def bent_line(tip: float, count: int = 200) -> tuple[float, Array, Array]:
    """Return P L^2 / EI, line (count, 2) and slopes of an elastica under a dead load across it.

    `tip` is the slope there, in (0, pi/2) [rad].

    Source: Bisshopp, Drucker (1945), Quart. Appl. Math. 3.
    """
    m, sine = (1 + math.sin(tip)) / 2, math.sin(tip)
    slopes = tip * np.sin(np.linspace(0, math.pi / 2, count))
    phase = np.arcsin(np.sqrt(np.minimum((1 + np.sin(slopes)) / (2 * m), 1.0)))
    F = ellipkinc(phase, m) - ellipkinc(phase[0], m)
    E = ellipeinc(phase, m) - ellipeinc(phase[0], m)
    x = math.sqrt(2) * (math.sqrt(sine) - np.sqrt(np.abs(sine - np.sin(slopes))))
    return float(F[-1]) ** 2, np.stack([x, F - 2 * E], axis=1) / F[-1], slopes


def buckled_line(tip: float, count: int = 200) -> tuple[float, Array, Array]:
    """Return P over the critical load, line (count, 2) and slopes of an elastica pushed along it.

    Points are at equal steps of length; `tip` is the slope there, in (0, pi) [rad].

    Source: Timoshenko, Gere (1961), Theory of Elastic Stability, section 2.7.
    """
    k = math.sin(tip / 2)
    phase = np.linspace(0, math.pi / 2, 20 * count)
    F, E, K = ellipkinc(phase, k * k), ellipeinc(phase, k * k), float(ellipk(k * k))
    columns = (2 * E - F) / K, 2 * k * (1 - np.cos(phase)) / K, 2 * np.arcsin(k * np.sin(phase))
    x, z, slopes = (np.interp(np.linspace(0, 1, count), F / K, column) for column in columns)
    return (2 * K / math.pi) ** 2, np.stack([x, z], axis=1), slopes


def at_load(line: Line, load: float) -> tuple[float, Array, Array]:
    """Return the member of a family of elasticas that carries a load."""
    steepest = 1.57 if line is bent_line else 3.0
    return line(brentq(lambda tip: line(tip)[0] - load, 1e-3, steepest, xtol=1e-13))


def elastica(folder: Path) -> Section:
    """Bend slender beams through large rotations."""
    found, shapes = {}, {}
    for name, (cells, cell, degree) in KINDS.items():
        problem = slender(SVK, cells, cell, degree)
        newton = fem.Newton(problem)
        unit = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -1 / 12 / 400]).on(problem)
        for load in BENT:
            u = balanced(newton, load * unit).displacement[0]
            shapes[name, load] = problem, u
            found[name, load] = -mean(u[:, 2], unit[:, 2]), -mean(u[:, 0], unit[:, 2])
    rows = [
        Row(f"{name}, α = {load:g}: {what}/L", BENT[load][k], found[name, load][k], 6e-3)
        for name in list(KINDS)[:2]
        for load in (0.1, 1.0, 4.0, 10.0)
        for k, what in enumerate("wu")
    ]
    off = {name: 100 * (found[name, 1.0][0] / float(BENT[1.0][0]) - 1) for name in KINDS}
    rows += [
        Row(f"{name}, α = 1: error of w/L [%], same mesh", printed, off[name])
        for name, printed in LOCKED.items()
    ]
    thick = "hex27, 20 × 1 × 1"
    rows += [
        Row(f"{thick}, α = {load:g}: w/L, same mesh", printed, found[thick, load][0])
        for load, printed in SAME.items()
    ]
    _draw_bent(folder / "elastica.png", found, shapes)
    return Section(
        "Elastica",
        "Bisshopp, Drucker 1945; Mattiasson 1981",
        "A cantilever of 20 × 1 × 1 (SVK, ν = 0) under a transverse dead load, α = PL²/EI. "
        "Tolerance: 0.6 %, since the elastica neither shears nor stretches.",
        rows,
        "Linear elements lock in bending: at α = 1 the error of hex8 is "
        f"{off['hex8, 40 × 2 × 2']:.0f} %, that of tet4 {off['tet4, 40 × 2 × 2']:.0f} %, and "
        f"that of hex27 with as many nodes {off[thick]:+.2f} %.",
    )


def _draw_bent(path: Path, found: Any, shapes: Any) -> None:
    with picture(path, 3.3) as figure:
        ax = panel(figure, 1, "load α = PL²/EI [-]", "displacement of the tip / L [-]", "(a)")
        lines = [bent_line(tip, 100) for tip in np.linspace(0.01, 1.475, 120)]
        alpha, ends = [line[0] for line in lines], np.array([line[1][-1] for line in lines])
        curve(ax, alpha, ends[:, 1], "elastica")
        curve(ax, alpha, 1 - ends[:, 0])
        for k, label in ((0, "its printed values"), (1, None)):
            reference(ax, list(BENT), [float(tip[k]) for tip in BENT.values()], label)
        for k, name in enumerate(KINDS):
            loads = list(BENT)[:: 1 if k != 1 else 2]
            for what in (0, 1) if k < 2 else (0,):  # the linear ones would hide the others
                tips = [found[name, load][what] for load in loads]
                measured(ax, loads, tips, k, None if what else name, linestyle="none")
        for y, text in ((0.85, "w/L"), (0.595, "u/L")):
            ax.text(10.3, y, text, ha="right")
        ax.set(xlim=(-0.2, 10.4), ylim=(-0.02, 0.92))
        ax.legend(loc="lower right")
        ax = panel(figure, 2, "x/L [-]", "z/L [-]", "(b)", aspect="equal")
        ax.grid(False)
        for k, load in enumerate((0.5, 1.0, 2.0, 4.0, 10.0)):
            body, u = shapes["hex27, 20 × 1 × 1", load]
            _draw_side(ax, body, u, COLOURS[k])
            x, z = at_load(bent_line, load)[1].T * [[1], [-1]] + [[0], [0.025]]
            curve(ax, x, z)
            ax.annotate(
                *(f"α = {load:g}", (x[-1], z[-1]), (0, -12 if k else 9)),
                **{"textcoords": "offset points", "ha": "center"},
            )
        ax.set(xlim=(-0.03, 1.12), ylim=(-0.92, 0.08))


def _draw_side(
    ax: Any, problem: fem.Problem, u: Tensor, colour: str, at: float | None = None
) -> None:
    """Draw a slender beam seen across; upright, at a place, if that is given."""
    nodes = lattice(problem.points.numpy())[:, 0]
    places = (problem.points + u).numpy()[:, [0, 2]]
    side(ax, places if at is None else places[:, ::-1] + [at, 0.0], nodes, colour, problem.degree)


EULER = math.pi**2 / 4  # P L^2 / EI at which a column, clamped below, free above, buckles
NEWTON = 100 / (1000 / 12)  # P L^2 / EI of 1 N on the column 10 x 1 x 1 m, E = 1000 Pa
CRITICAL: list[tuple[fem.Material, tuple[int, int, int], str]] = [  # [N]
    (SVK, (10, 1, 1), "2.039763"),
    (SVK, (20, 2, 2), "2.037811"),
    (fem.NeoHookeanLn(0.0), (10, 1, 1), "2.056558"),
]
BUCKLED = {2.5: (".6873", ".3885"), 4.0: (".7925", ".9731")}  # P [N]: w / L, u / L, SVK, L/h = 10
POST = {2.5: (".66363", ".34682"), 4.0: (".80022", ".90518")}  # the same, elastica
LOADS = (4.0, 3.75, 3.5, 3.25, 3.0, 2.75, 2.5, 2.35, 2.2, 2.12, 2.08, 2.06, 2.05)  # [N]


def pushed(problem: fem.Problem, P: float) -> Tensor:
    """Return the forces (N, D) [-] on a slender column whose P L^2 / EI is that of P [N]."""
    thick = float(problem.points[:, 1].max())
    return fem.Traction(fem.Plane(0, "max"), [-P * NEWTON * thick**2 / 12, 0.0, 0.0]).on(problem)


def critical(law: fem.Material, cells: Sequence[int]) -> float:
    """Return the load P [N] at which the tangent of a straight column becomes singular."""
    problem = slender(law, cells)
    newton, unit = fem.Newton(problem, tol=1e-10), pushed(problem, 1.0)
    tangents, low, high = make_backend(problem.pattern), 2.0, 2.1
    while high - low > 2e-7:
        middle = (low + high) / 2
        u = balanced(newton, middle * unit).displacement
        factor = tangents.factorise(problem.linearise(u).tangent[0].numpy())
        low, high = (low, middle) if factor.negative_pivots else (middle, high)
    return (low + high) / 2


def bent_branch(cells: Sequence[int], lowest: float) -> dict[float, tuple[fem.Problem, Any, Any]]:
    """Return body, solution and tip (w/L, u/L) of a buckled column by loads [N].

    The first answer is reached by a guess, the elastica's shape; each of the others by the last.
    """
    problem = slender(SVK, cells)
    newton, unit = fem.Newton(problem), pushed(problem, 1.0)
    _, line, slopes = at_load(buckled_line, LOADS[0] * NEWTON / EULER)
    X = problem.points.numpy()
    x, z, slope = (np.interp(X[:, 0], np.linspace(0, 1, 200), v) for v in (*line.T, slopes))
    height = X[:, 2] - X[:, 2].mean()  # sections stay plane and across the line
    places = [x - height * np.sin(slope), X[:, 1], X[:, 2] - height + z + height * np.cos(slope)]
    guess, found = torch.from_numpy(np.stack(places, axis=1) - X)[None], {}
    for P in LOADS:
        if lowest < P:
            answer = balanced(newton, P * unit, guess)
            guess = answer.displacement
            tip = mean(guess[0, :, 2], unit[:, 0]), -mean(guess[0, :, 0], unit[:, 0])
            found[P] = problem, answer, tip
    return found


def buckling(folder: Path) -> Section:
    """Buckle columns and follow the bent branch."""
    rows = []
    for law, cells, printed in CRITICAL:
        name = f"{'SVK' if law is SVK else 'NH-ln'}, {' × '.join(map(str, cells))}"
        rows.append(
            Row(f"{name}: critical load [N], same mesh", printed, critical(law, cells), 2e-6)
        )
    lowest, slim = rows[1].value, critical(SVK, (40, 1, 1))
    rows.append(Row("SVK, L/h = 40: critical load [N], Euler", "2.056168", slim, 2e-3))
    problem = slender(SVK, (10, 1, 1))
    answer = balanced(fem.Newton(problem), pushed(problem, 2.5))
    down = 10 * float(answer.displacement[..., 0].min())
    rows += [
        Row("10 × 1 × 1, from rest, P = 2.5 N: u_x of the tip [m], same mesh", "-0.02509", down),
        Row("the same: negative eigenvalues of K", "2", float(answer.negative_pivots)),
    ]
    branches = {10: bent_branch((20, 2, 2), lowest), 40: bent_branch((40, 1, 1), slim)}
    for ratio, table, source, within in (
        *((10, BUCKLED, "same mesh", None), (40, POST, "elastica", 0.01)),
        (10, POST, "elastica", 0.01),
    ):
        for P, tip in table.items():
            for k, what in enumerate("wu"):
                name = f"L/h = {ratio}, bent, P = {P:g} N: {what}/L, {source}"
                rows.append(Row(name, tip[k], branches[ratio][P][2][k], within))
    problem = slender(SVK, (20, 2, 2))
    newton, unit = fem.Newton(problem), pushed(problem, 1.0)
    straight = {P: balanced(newton, P * unit) for P in np.arange(0.5, 4.1, 0.25).tolist()}
    _draw_buckled(folder / "buckling.png", problem, straight, branches)
    flagged = [P for P, answer in straight.items() if answer.status == fem.Status.UNSTABLE]
    bent = [answer.status for branch in branches.values() for _, answer, _ in branch.values()]
    return Section(
        "Buckling",
        "independent code (*same mesh*), Euler, elastica",
        "A clamped column of 10 × 1 × 1 m (E = 1000 Pa, ν = 0, hex27) and one with L/h = 40 under "
        "axial dead loads. Tolerances: 2e-6 for critical loads, 0.2 % for Euler's, 1 % for the "
        "elastica.",
        rows,
        "From rest Newton finds the straight column at every load, with the status *unstable* "
        f"for {len(flagged)} of the {sum(lowest < P for P in straight)} loads above the critical "
        f"one, for {sum(lowest > P for P in flagged)} of {sum(lowest > P for P in straight)} "
        f"below it, and for {bent.count(int(fem.Status.UNSTABLE))} of {len(bent)} solutions on the "
        "bent branches. The values in bold differ because the column with L/h = 10 shears and "
        f"shortens (critical load {100 * (1 - lowest / 2.056168):.1f} % below Euler's); the "
        "independent code has the same values.",
    )


def _draw_buckled(path: Path, problem: fem.Problem, straight: Any, branches: Any) -> None:
    unit = NEWTON / EULER
    with picture(path, 3.3) as figure:
        ax = panel(figure, 1, "load / Euler's critical load [-]", "deflection w/L [-]", "(a)")
        lines = [buckled_line(tip, 20) for tip in np.linspace(0.01, 2.6, 120)]
        curve(ax, [line[0] for line in lines], [line[1][-1, 1] for line in lines], "elastica")
        values = [float(tip[0]) for tip in POST.values()]
        reference(ax, [P * unit for P in POST], values, "its printed values")
        for k, (ratio, branch) in enumerate(branches.items()):
            w = [tip[0] for *_, tip in branch.values()]
            loads = np.array([*branch]) * unit
            measured(ax, loads, w, k, f"bent, L/h = {ratio}", linestyle="none")
        flags = {"stable": fem.Status.CONVERGED, "unstable": fem.Status.UNSTABLE}
        for k, (how, status) in enumerate(flags.items(), 2):
            loads = np.array([P for P, answer in straight.items() if answer.status == status])
            style = {"marker": "x", "markersize": 5} if k == 3 else {}
            measured(ax, loads * unit, 0 * loads, k, f"from rest, {how}", linestyle="none", **style)
        ax.set(xlim=(0.15, 2.05), ylim=(-0.05, 0.88), xticks=[0.5, 1, 1.5, 2])
        ax.legend(loc="upper left", bbox_to_anchor=(-0.02, 1.02))
        ax = panel(figure, 2, "z/L [-]", "x/L [-]", "(b)", aspect="equal")
        ax.grid(False)
        for P, at in ((2.5, 0.0), (4.0, 1.15)):
            _draw_side(ax, problem, straight[P].displacement[0], COLOURS[3], at)
            body, answer, _ = branches[10][P]
            _draw_side(ax, body, answer.displacement[0], COLOURS[0], at)
            x, z = at_load(buckled_line, P * unit)[1].T
            curve(ax, z + 0.05 + at, x)
            ax.text(at, 1.05, f"P = {P:g} N", ha="left")
        ax.set(
            xlim=(-0.12, 2.1), ylim=(-0.08, 1.18), xticks=[0, 0.5, 1, 1.5, 2], yticks=[0, 0.5, 1]
        )

"""The paper's beam, convergence of Newton, and identities that every solution satisfies."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks import peers
from benchmarks.study import picture
from benchmarks.verification.bodies import NAMES, Array, balanced, paper_beam
from benchmarks.verification.drawing import curve, measured, panel, reference, triangle
from benchmarks.verification.report import Row, Section
from dpl.fem import Material, NeoHookeanLn, Newton, Plane, Problem, SaintVenantKirchhoff, Traction

# u_z of the corner (100, 25, 25) [m]: SVK at q = 5, 20, 40 Pa, NH-ln at q = 40 Pa
BEAM: dict[tuple[str, tuple[int, int, int], int], str] = {
    ("hexahedron", (8, 2, 2), 1): "-6.3661 -24.79226 -44.77862 -44.71446",
    ("hexahedron", (16, 4, 4), 1): "-7.06306 -27.28787 -48.38715 -48.34221",
    ("hexahedron", (39, 9, 9), 1): "-7.30886 -28.15840 -49.62752 -49.59254",
    ("hexahedron", (8, 2, 2), 2): "-7.32678 -28.2134 -49.67143 -49.65505",
    ("hexahedron", (16, 4, 4), 2): "-7.36089 -28.3413 -49.88316 -49.8554",
    ("tetra", (8, 2, 2), 2): "-7.29293 -28.08539 -49.46152 -49.50036",
}
LIMIT = -28.387  # SVK at q = 20 Pa, Richardson's limit of these meshes [m]
SVK, NH = SaintVenantKirchhoff(0.3), NeoHookeanLn(0.3)
DRAWN = ("hex8, 8 × 2 × 2", "hex8, 39 × 9 × 9", "hex27, 16 × 4 × 4")


def bent(
    law: Material, kind: tuple[str, tuple[int, int, int], int], loads: Sequence[float]
) -> dict[float, float]:
    """Return u_z of the corner [m] of the paper's beam by tractions q [Pa]."""
    cell, cells, degree = kind
    problem = paper_beam(law, cells, cell, degree)
    newton, corner = Newton(problem), int(problem.points.sum(dim=1).argmax())
    unit = Traction(Plane(0, "max"), [0.0, 0.0, -1 / 4500]).on(problem)
    tips = [balanced(newton, q * unit).displacement[0, corner, 2] for q in loads]
    return {q: 100 * float(tip) for q, tip in zip(loads, tips, strict=True)}


def beam(folder: Path) -> Section:
    """Bend the paper's beam and measure the convergence of Newton."""
    rows, curves, tips = [], {}, {}
    for kind, printed in BEAM.items():
        cell, cells, degree = kind
        name = f"{NAMES[cell, degree]}, {' × '.join(map(str, cells))}"
        loads = np.arange(5.0, 41.0, 5.0).tolist() if name in DRAWN else [5.0, 20.0, 40.0]
        curves[name] = bent(SVK, kind, loads), [float(text) for text in printed.split()[:3]]
        found = [curves[name][0][q] for q in (5.0, 20.0, 40.0)] + [bent(NH, kind, [40.0])[40.0]]
        tips[name] = found[1]
        for k, what in ((1, "SVK, q = 20 Pa"), (2, "SVK, q = 40 Pa"), (3, "NH-ln, q = 40 Pa")):
            within = 5e-3 if cell == "tetra" else 1e-6
            rows.append(Row(f"{name}, {what}: u_z [m]", printed.split()[k], found[k], within))
    problem, load = peers.CASES["S1"].build()
    states = {
        mixed: list(Newton(problem, tol=1e-10, mixed_integration=mixed).iterate(load))
        for mixed in (False, True)
    }
    end = states[True][-1].displacement[0, peers.Case.end(problem)].mean(dim=0) * problem.length
    for axis, known in zip((0, 2), peers.CASES["S1"].tip, strict=True):
        what = f"scene S1: mean of u_{'xyz'[axis]} over the end face [m], nine codes"
        rows.append(Row(what, f"{known:.12f}", float(end[axis]), 1e-9))
    residuals = {mixed: [float(s.residual) for s in states[mixed]] for mixed in states}
    counts = [sum(r >= 1e-8 for r in residuals[mixed]) for mixed in (False, True)]
    _draw_beam(folder / "beam.png", curves, residuals)
    off = {name: abs(100 * (tip / LIMIT - 1)) for name, tip in tips.items()}
    return Section(
        "The paper's beam",
        "independent code; scene S1: nine public codes",
        "100 × 25 × 25 m, E = 4500 Pa, ν = 0.3, a dead traction q on the end. Tolerances: 1e-6, "
        "and 0.5 % for tetrahedra. Scene S1 is NH-ln under 20,100 N.",
        rows,
        f"On scene S1 the standard method needs {counts[0]} iterations to 1e-8 and mixed "
        f"integration points {counts[1]}; its residual first increases to "
        f"{max(residuals[False]):.0f} times the load. A correct solution of a mesh has a "
        f"discretisation error: from the limit of {LIMIT} m at q = 20 Pa, hex8 with 12,000 "
        f"degrees of freedom differs by {off['hex8, 39 × 9 × 9']:.1f} %, hex27 with 8,019 by "
        f"{off['hex27, 16 × 4 × 4']:.1f} %, hex27 with 1,275 by {off['hex27, 8 × 2 × 2']:.1f} %.",
    )


def _draw_beam(path: Path, curves: dict[str, Any], residuals: dict[bool, list[float]]) -> None:
    with picture(path) as figure:
        ax = panel(figure, 1, "traction q [Pa]", "deflection −u$_z$ of the corner [m]", "(a)")
        for k, name in enumerate(DRAWN):
            tips, known = curves[name]
            measured(ax, [0, *tips], [0, *(-tip for tip in tips.values())], k, name)
            label = "independent code" if k == 2 else None
            reference(ax, (5, 20, 40), [-tip for tip in known], label)
        ax.legend(loc="lower right")
        ax = panel(figure, 2, "iteration [-]", "‖R‖/‖f‖ [-]", "(b)", yscale="log")
        for k, (mixed, name) in enumerate(((False, "plain"), (True, "mixed integration points"))):
            measured(ax, range(len(residuals[mixed])), residuals[mixed], k, name)
        curve(ax, [0, max(map(len, residuals.values())) - 1], [1e-8, 1e-8], linestyle="--")
        ax.text(0, 1.8e-8, "tolerance of an answer", va="bottom", fontsize=7.5)
        ax.legend(loc="upper right")


def balance(folder: Path) -> Section:
    """Check identities that every solution satisfies."""
    problem = paper_beam(NH, (8, 2, 2))
    newton = Newton(problem, tol=1e-12)
    unit = Traction(Plane(0, "max"), [0.0, 0.0, -1 / 4500]).on(problem)
    u = balanced(newton, 20 * unit).displacement
    random = torch.Generator().manual_seed(3)
    direction = torch.randn(u.shape, generator=random, dtype=torch.float64)
    direction = torch.where(problem.free, direction, 0.0)
    internal, product = problem.internal_force(u), problem.tangent_product(u, direction)
    steps = 3e-5 * 0.5 ** torch.arange(6, dtype=torch.float64)
    change = problem.energy(u + steps[:, None, None] * direction) - problem.energy(u)
    first = change - steps * (internal * direction).sum()
    second = first - steps**2 / 2 * (product * direction).sum()
    rates = [(math.log2(r[0] / r[1]), math.log2(r[2] / r[3])) for r in (first, second)]
    sizes = 10.0 ** np.arange(-3, -10.5, -0.5)
    moved = torch.tensor(sizes)[:, None, None] * direction
    slopes = problem.internal_force(u + moved) - problem.internal_force(u - moved)
    slopes = slopes / (2 * torch.tensor(sizes)[:, None, None])
    off = torch.where(problem.free, slopes - product, 0.0).flatten(1).norm(dim=1)
    off = (off / torch.where(problem.free, product, 0.0).norm()).numpy()
    rows = [
        Row("Taylor remainder of the energy without K: order", "2.00", rates[0][1], 0.01),
        Row("Taylor remainder of the energy with K: order", "3.00", rates[1][1], 0.02),
        Row(
            "differences of f_int against K d: smallest relative error", "< 1e-8", float(off.min())
        ),
        *_invariance(problem, u, 20 * unit),
        *_work(problem, unit),
    ]
    with picture(folder / "balance.png") as figure:
        log = {"xscale": "log", "yscale": "log"}
        ax = panel(figure, 1, "step h [-]", "|remainder| of the energy / EL³ [-]", "(a)", **log)
        for k, (values, name) in enumerate(((first, "gradient"), (second, "gradient and K"))):
            measured(ax, steps, values.abs(), k, name)
        triangle(ax, 1.2e-5, 5e-10, 2)
        triangle(ax, 1.2e-5, 1e-13, 3)
        ax.legend(loc="upper left")
        what = "relative error of the difference quotient [-]"
        ax = panel(figure, 2, "step h [-]", what, "(b)", **log)
        measured(ax, sizes, off, 2)
        triangle(ax, 1e-4, off[2] / 3, 2, rise=4.0)
    return Section(
        "Balance identities",
        "independent code",
        "Identities that hold for every solution, on the paper's beam with 8 × 2 × 2 hexahedra "
        "(NH-ln, q = 20 Pa).",
        rows,
    )


def _invariance(problem: Problem, u: Tensor, force: Tensor) -> list[Row]:
    """Return balance of forces and moments, and objectivity."""
    turn = torch.tensor([[0, -0.7, 0.4], [0.7, 0, -1.1], [-0.4, 1.1, 0]], dtype=torch.float64)
    internal, X, Q = problem.internal_force(u), problem.points, torch.linalg.matrix_exp(turn)
    reactions = torch.where(problem.free, 0.0, internal)
    forces = (reactions + force).sum(dim=(0, 1)).abs().max() / force.sum().abs()
    arms = torch.linalg.cross(X + u, internal)
    moments = arms.sum(dim=1).abs().max() / arms.norm(dim=2).sum()
    turned = (X + u) @ Q.T + torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64) - X
    objective = (problem.internal_force(turned) - internal @ Q.T).norm() / internal.norm()
    energy = (problem.energy(turned) / problem.energy(u) - 1).abs()
    rigid = problem.internal_force((X @ Q.T - X)[None]).norm() / (1 / 16)
    return [
        Row("reactions + loads, over the load", "< 1e-10", float(forces)),
        Row(
            "moments of nodal forces about the deformed body, over their sizes",
            "< 1e-12",
            float(moments),
        ),
        Row("moved and turned body: forces, relative", "< 1e-12", float(objective)),
        Row("moved and turned body: energy, relative", "< 1e-12", float(energy)),
        Row("rotation alone: ‖f‖/(EA)", "< 1e-13", float(rigid)),
    ]


def _work(problem: Problem, unit: Tensor) -> list[Row]:
    """Return the work of the load against the energy, and the slope of the total energy."""
    newton = Newton(problem, tol=1e-11)
    scale = 4500 * 100.0**3  # E L^3 [J]

    def path(loads: Sequence[float]) -> tuple[Array, Array]:
        """Return energies [J] and strokes f u / q [m3] at loads [Pa]."""
        answers = [balanced(newton, q * unit).displacement for q in loads]
        energy = [float(problem.energy(u)) * scale for u in answers]
        return np.array(energy), np.array([float((unit * u).sum()) * scale for u in answers])

    loads = np.linspace(0.0, 20.0, 41)
    energy, stroke = path(loads.tolist())
    weights = np.array([1] + [4, 2] * 19 + [4, 1]) * (loads[1] / 3)
    work = 20 * stroke[-1] - weights @ stroke  # by parts
    around = np.array([19.9, 20.1])
    total = path(around.tolist())
    slope = float(np.diff(total[0] - around * total[1])[0]) / 0.2
    return [
        Row("strain energy U [J]", "145989.0724", float(energy[-1])),
        Row("work of the load ∫ q d(f·u) [J], Simpson, 40 steps", "145989.0722", float(work)),
        Row("work / U", "1", float(work / energy[-1]), 1e-8),
        Row("stroke f·u/q [m³]", "15003.700988", float(stroke[-1])),
        Row("d(U − q f·u)/dq, differences of 0.1 Pa [m³]", "-15003.684431", slope),
    ]

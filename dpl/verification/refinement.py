"""Elements under refinement and near incompressibility: errors, Cook's membrane, locking."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import skfem
import torch
from torch import Tensor

from dpl.fem.forces import Traction, body_force
from dpl.fem.materials import Material, NeoHookeanIsoK4, NeoHookeanLn, SaintVenantKirchhoff
from dpl.fem.mesh import Plane, box, rectangle
from dpl.fem.newton import Linear, Newton
from dpl.fem.problem import Problem
from dpl.verification.bodies import NAMES, Array, balanced, lattice
from dpl.verification.drawing import COLOURS, measured, panel, picture, reference, side, triangle
from dpl.verification.report import Row, Section


# cell, degree: cells a side, error in L2, error in the H1-seminorm; NH-ln, A = 0.1
ERRORS: dict[tuple[str, int], tuple[list[int], str, str]] = {
    ("hexahedron", 1): (
        [2, 4, 8, 16],
        "1.7844e-2 4.6365e-3 1.1694e-3 2.9296e-4",
        "1.1184e-1 5.6220e-2 2.8064e-2 1.4022e-2",
    ),
    ("hexahedron", 2): (
        [1, 2, 4, 8],
        "2.8187e-3 1.6993e-3 2.1432e-4 2.6811e-5",
        "3.3631e-2 2.2007e-2 5.5546e-3 1.3900e-3",
    ),
    ("tetra", 1): ([2, 4, 8, 16], "2.1458e-2 6.0357e-3 1.6041e-3 4.1073e-4", "2.0664e-2"),
    ("tetra", 2): ([1, 2, 4, 8], "1.5808e-2 2.6990e-3 3.4504e-4 4.2559e-5", "2.4995e-3"),
}


def manufactured(x: Tensor) -> Tensor:
    """Return the displacement (3,) chosen for the unit cube at a point (3,)."""
    X, Y, Z = math.pi * x
    u = (X.sin() * (Y / 2).cos(), (Y / 2).cos() * Z.sin(), x[1] * (X / 2).sin() * Z.sin())
    return 0.1 * torch.stack(u)


def errors(cell: str, degree: int, n: int) -> tuple[float, float]:
    """Return the errors of the manufactured answer on n^3 cells, L2 and H1-seminorm [-]."""
    law = NeoHookeanLn(0.3)
    gradient = torch.func.jacrev(manufactured)

    def load(x: Tensor) -> Tensor:  # -Div P
        return -torch.einsum(
            "ijkl,klj->i", law.tangent(gradient(x)), torch.func.jacfwd(gradient)(x)
        )

    def at(what: Callable[[Tensor], Tensor], x: Array) -> Array:
        """Evaluate a field of one point at (3, E, Q); its components come first."""
        values = torch.func.vmap(what)(torch.from_numpy(x.reshape(3, -1).T.copy()))
        return np.moveaxis(values.numpy(), 0, -1).reshape(*values.shape[1:], *x.shape[1:])

    mesh = box([1.0] * 3, [n + 1] * 3, cell)
    bare = Problem.build(mesh, law, degree=degree, length=1.0)
    given = torch.func.vmap(manufactured)(bare.points).numpy()
    problem = Problem.build(
        mesh, law, fixed=bare.boundary.numpy(), prescribed=given, degree=degree, length=1.0
    )
    force = body_force(problem, lambda x: at(load, x))
    answer = balanced(Newton(problem), force).displacement[0].numpy()
    fine = skfem.Basis(mesh, problem.basis.elem, intorder=7)
    x = np.asarray(fine.global_coordinates())
    u, slope = at(manufactured, x), at(gradient, x)
    found = [fine.interpolate(component) for component in answer.T]
    off = sum((np.asarray(f) - u[i]) ** 2 for i, f in enumerate(found))
    off_slope = sum(((f.grad - slope[i]) ** 2).sum(axis=0) for i, f in enumerate(found))
    return math.sqrt((off * fine.dx).sum()), math.sqrt((off_slope * fine.dx).sum())


def order(folder: Path) -> Section:
    """Measure the order of accuracy of the four solid elements."""
    rows, found = [], {}
    for (cell, degree), (counts, L2, H1) in ERRORS.items():
        found[cell, degree] = values = np.array([errors(cell, degree, n) for n in counts])
        rates = np.log2(values[-2] / values[-1])
        name, last = NAMES[cell, degree], f"{counts[-1]}³ cells"
        within = 5e-4 if cell == "hexahedron" else 0.1
        rows += [
            Row(f"{name}, L2 error, {last}", L2.split()[-1], values[-1, 0], within),
            Row(f"{name}, H1 error, {last}", H1.split()[-1], values[-1, 1], within),
            Row(f"{name}, order in L2, last pair", f"> {degree + 0.9}", rates[0]),
            Row(f"{name}, order in H1, last pair", f"> {degree - 0.05:.2f}", rates[1]),
        ]
    with picture(folder / "order.png", 3.4) as figure:
        log = {"xscale": "log", "yscale": "log"}
        for place, what in ((1, "L2 error of u [-]"), (2, "H1 error of u (seminorm) [-]")):
            ax = panel(figure, place, "cell size h/L [-]", what, f"({'ab'[place - 1]})", **log)
            for k, (kind, (counts, *printed)) in enumerate(ERRORS.items()):
                h, known = 1 / np.array(counts), printed[place - 1].split()
                measured(ax, h, found[kind][:, place - 1], k, NAMES[kind])
                reference(
                    ax, h[-len(known) :], [float(e) for e in known], "reference" if k == 3 else None
                )
            ticks = [1, 1 / 2, 1 / 4, 1 / 8, 1 / 16]
            ax.set_xticks(ticks, ["1", "1/2", "1/4", "1/8", "1/16"])
            ax.minorticks_off()
            low = (
                [(0.125, 5.5e-4, 2), (0.25, 7e-5, 3)]
                if place == 1
                else [(0.14, 9e-3, 1), (0.3, 2e-3, 2)]
            )
            for x, y, p in low:
                triangle(ax, x, y, p)
        ax.legend(loc="lower right")
    return Section(
        "Order of accuracy",
        "Manufactured solution on the unit cube (NH-ln, ν = 0.3): u₁ = A sin πx cos πy/2, "
        "u₂ = A cos πy/2 sin πz, u₃ = A y sin πx/2 sin πz with A = 0.1 on the whole boundary, the "
        "body force −Div P by automatic differentiation. References: errors of an independent "
        "code, to 5e-4 for hexahedra; its tetrahedra lie along another diagonal of the cube, so "
        "within 10 % for them. Orders must exceed p + 0.9 in L2 and p − 0.05 in H1.",
        rows,
        [("order.png", "Errors against cell size, with triangles of the theoretical slopes.")],
    )


COOK = {  # degree: cells a side, displacement u_y at (48, 52) [mm]
    1: ([2, 4, 8, 16, 32, 64], "8.638 12.07 13.86 14.49 14.67 14.72"),
    2: ([2, 4, 8, 16, 32, 64], "14.30 14.65 14.71 14.73 14.74 14.74"),
}
FINER = {  # degree, cells a side: the same by an independent code
    (1, 2): "8.6384",
    (1, 4): "12.0712",
    (1, 8): "13.8632",
    (1, 16): "14.4853",
    (2, 2): "14.3018",
    (2, 4): "14.6494",
    (2, 8): "14.7139",
}


def membrane(law: Material, n: int, degree: int) -> tuple[Problem, Tensor]:
    """Return Cook's membrane of n^2 cells in plane strain with its displacement [mm]."""
    mesh = rectangle([1.0, 1.0], [n + 1, n + 1])
    x, y = mesh.p
    mesh = type(mesh)(np.stack([48 * x, 44 * x + y * (44 - 28 * x)]), mesh.t)
    problem = Problem.build(mesh, law, fixed=Plane(0, "min"), degree=degree)
    young = 0.4225 * 2.6  # [N/mm2], of mu = 0.4225 and nu = 0.3
    force = Traction(Plane(0, "max"), [0.0, 1 / 16 / young]).on(problem)
    return problem, balanced(Newton(problem), force).displacement[0] * problem.length


def _at(problem: Problem, field: Tensor, *place: float) -> Tensor:
    """Return a nodal field at the node nearest a place [of the unit of `length`]."""
    away = problem.points * problem.length - torch.tensor(place, dtype=torch.float64)
    return field[int(away.norm(dim=1).argmin())]


def cook(folder: Path) -> Section:
    """Refine Cook's membrane."""
    law, rows, found = NeoHookeanIsoK4(0.3), [], {}
    for degree, (counts, printed) in COOK.items():
        for n, known in zip(counts, printed.split(), strict=True):
            problem, u = membrane(law, n, degree)
            found[degree, n] = float(_at(problem, u, 48, 52)[1])
            what = f"Q{degree}, {n} × {n}: u_y(48, 52) [mm]"
            rows.append(Row(f"{what}, deal.II", known, found[degree, n]))
            if (degree, n) in FINER:
                known = FINER[degree, n]
                rows.append(Row(f"{what}, independent code", known, found[degree, n]))
            if (degree, n) == (2, 8):
                shown, corner = (problem, u), _at(problem, u, 48, 60)
                tip = _at(problem, u, 48, 52)
    rows += [
        Row("Q2, 8 × 8: u_x(48, 60) [mm]", "-13.8264", float(corner[0])),
        Row("Q2, 8 × 8: u_y(48, 60) [mm]", "13.7505", float(corner[1])),
    ]
    others = (
        ("NH-ln, Q1, 8 × 8", NeoHookeanLn(0.3), 1, "13.700585"),
        ("NH-ln, Q2, 8 × 8", NeoHookeanLn(0.3), 2, "14.4831"),
        ("SVK, Q2, 8 × 8", SaintVenantKirchhoff(0.3), 2, "13.6261"),
    )
    for what, other, degree, known in others:
        value = float(_at(*membrane(other, 8, degree), 48, 52)[1])
        rows.append(Row(f"{what}: u_y(48, 52) [mm]", known, value))
    with picture(folder / "cook.png") as figure:
        ax = panel(figure, 1, "cells a side [-]", "u$_y$ at (48, 52) [mm]", "(a)", xscale="log")
        for k, (degree, (counts, printed)) in enumerate(COOK.items()):
            reference(
                ax, counts, [float(text) for text in printed.split()], "deal.II" if k else None
            )
            measured(ax, counts, [found[degree, n] for n in counts], k, f"Q{degree}")
        ax.set_xticks(counts, [str(n) for n in counts])
        ax.minorticks_off()
        ax.legend(loc="lower right")
        ax = panel(figure, 2, "x [mm]", "y [mm]", "(b) Q2, 8 × 8 cells", aspect="equal")
        problem, u = shown
        X = problem.points.numpy() * problem.length
        x, y = X.T / 48
        nodes = lattice(np.stack([x, (y * 48 - 44 * x) / (44 - 28 * x)], axis=1))
        side(ax, X, nodes, "0.6", 2)
        side(ax, X + u.numpy(), nodes, COLOURS[1], 2)
        for place, text in (((48, 52), "(48, 52)"), (np.array([48, 52]) + tip.numpy(), "")):
            ax.plot(*place, "k.", markersize=5)
            ax.annotate(text, place, (4, -3), textcoords="offset points")
        ax.set(xticks=range(0, 61, 15), yticks=range(0, 76, 15), xlim=(-3, 63), ylim=(-3, 78))
    return Section(
        "Cook's membrane",
        "A tapered panel (corners (0, 0), (48, 44), (48, 60), (0, 44) mm), clamped on the left, "
        "under a dead shear traction of 1/16 N/mm² on the right, in plane strain at finite strain; "
        "NHiso-k4, μ = 0.4225 N/mm², ν = 0.3. References: the tables of deal.II's code gallery "
        "(*Quasi-static finite-strain compressible elasticity*, as corrected in 2021), whose mesh "
        "is one hexahedron thick with no displacement across it, which is the same; more digits "
        "and the other laws by an independent code (NH-ln on Q1 by felupe 11.3.0 as well).",
        rows,
        [("cook.png", "(a) Tip displacement against refinement, (b) rest and deformed mesh.")],
    )


POISSON = (0.3, 0.45, 0.49, 0.499, 0.4999)
LOCKING = {  # compliance over that of hex27, 16 x 4 x 4: cells, cell, degree, values
    "hex8, 16 × 4 × 4": ((16, 4, 4), "hexahedron", 1, ".960 .901 .753 .467 .209"),
    "tet4, 16 × 4 × 4": ((16, 4, 4), "tetra", 1, ".795 .615 .323 .103 .067"),
    "tet10, 8 × 2 × 2": ((8, 2, 2), "tetra", 2, ".991 .973 .957 .947 .945"),
    "hex27, 8 × 2 × 2": ((8, 2, 2), "hexahedron", 2, ".996 .981 .963 .954 .952"),
}


def compliance(
    nu: float, cells: Sequence[int], cell: str, degree: int, mean: bool = False
) -> float:
    """Return f u of the paper's beam under a small dead load across its end."""
    mesh = box([4.0, 1.0, 1.0], [n + 1 for n in cells], cell)
    law = NeoHookeanLn(nu)
    problem = Problem.build(mesh, law, fixed=Plane(0, "min"), degree=degree, mean_dilatation=mean)
    force = Traction(Plane(0, "max"), [0.0, 0.0, -1.0]).on(problem)
    return float((force * Linear(problem).respond(force)).sum())


def locking(folder: Path) -> Section:
    """Approach incompressibility with every element."""
    best = [compliance(nu, (16, 4, 4), "hexahedron", 2) for nu in POISSON]
    rows, found = [], {}
    for name, (cells, cell, degree, printed) in LOCKING.items():
        values = [
            compliance(nu, cells, cell, degree) / b for nu, b in zip(POISSON, best, strict=True)
        ]
        found[name] = values
        for nu, known, value in zip(POISSON, printed.split(), values, strict=True):
            if nu in (0.3, 0.49, 0.4999):
                rows.append(Row(f"{name}, ν = {nu}", known, value))
    name = "hex8 with mean dilatation, 16 × 4 × 4"
    found[name] = [
        compliance(nu, (16, 4, 4), "hexahedron", 1, True) / b
        for nu, b in zip(POISSON, best, strict=True)
    ]
    for nu, value in zip(POISSON, found[name], strict=True):
        rows.append(Row(f"{name}, ν = {nu}", "> 0.94", value))
    with picture(folder / "locking.png") as figure:
        ax = panel(figure, 1, "½ − ν [-]", "compliance / that of hex27, 16 × 4 × 4 [-]", columns=1)
        away = 0.5 - np.array(POISSON)
        for k, (name, values) in enumerate(found.items()):
            measured(ax, away, values, k, name)
            if name in LOCKING:
                known = [float(text) for text in LOCKING[name][3].split()]
                reference(ax, away, known, "independent code" if k == 3 else None)
        ax.set_xscale("log")
        ax.invert_xaxis()
        ax.set_xticks(away, [f"{a:.4g}\n(ν = {nu})" for a, nu in zip(away, POISSON, strict=True)])
        ax.minorticks_off()
        ax.set(ylim=(0, 1.08))
        ax.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return Section(
        "Nearly incompressible bodies",
        "Compliance f·u of the paper's beam (4 × 1 × 1) under a small load across its end, over "
        "that of hex27 on 16 × 4 × 4 cells, as ν approaches ½. References: an independent code. "
        "Elements that do not lock must stay above 0.94.",
        rows,
        [("locking.png", "Compliance ratio against Poisson's ratio; 1 is right, 0 is locked.")],
        [
            "hex8 and tet4 lock, as they must: dpl warns when it builds such a body "
            "(ν ≥ 0.45). With `mean_dilatation` hex8 does not; it ends up slightly softer "
            "than the hex27 that it is compared with, which is not exact either."
        ],
    )

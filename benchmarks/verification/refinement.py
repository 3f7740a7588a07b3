"""Elements under refinement and near incompressibility: errors, Cook's membrane, locking."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import skfem
import torch
from torch import Tensor

from benchmarks.study import picture
from benchmarks.verification.bodies import NAMES, Array, balanced, lattice
from benchmarks.verification.drawing import measured, panel, reference, side, triangle
from benchmarks.verification.report import Row, Section
from dpl import fem
from dpl.fem.loads import body_force
from dpl.visualization import COLOURS

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


def manufactured(x: Tensor, amplitude: float = 0.1) -> Tensor:
    """Return the manufactured displacement (3,) at a point (3,) of the unit cube."""
    X, Y, Z = math.pi * x
    u = (X.sin() * (Y / 2).cos(), (Y / 2).cos() * Z.sin(), x[1] * (X / 2).sin() * Z.sin())
    return amplitude * torch.stack(u)


def errors(
    cell: str, degree: int, n: int, law: fem.Material | None = None, amplitude: float = 0.1,
    *, mean_dilatation: bool = False,
) -> tuple[float, float]:  # fmt: skip
    """Return the errors of the manufactured solution on n^3 cells in L2 and the H1-seminorm [-].

    The law is NH-ln with a Poisson's ratio of 0.3 if left out.
    """
    law = law or fem.NeoHookeanLn(0.3)
    exact = partial(manufactured, amplitude=amplitude)
    gradient = torch.func.jacrev(exact)

    def load(x: Tensor) -> Tensor:  # -Div P
        return -torch.einsum(
            "ijkl,klj->i", law.tangent(gradient(x)), torch.func.jacfwd(gradient)(x)
        )

    def at(what: Callable[[Tensor], Tensor], x: Array) -> Array:
        """Evaluate a field of one point at (3, E, Q); its components come first."""
        values = torch.func.vmap(what)(torch.from_numpy(x.reshape(3, -1).T.copy()))
        return np.moveaxis(values.numpy(), 0, -1).reshape(*values.shape[1:], *x.shape[1:])

    mesh = fem.box([1.0] * 3, [n + 1] * 3, cell)
    bare = fem.Problem.build(mesh, law, degree=degree, length=1.0)
    given = torch.func.vmap(exact)(bare.points).numpy()
    problem = fem.Problem.build(
        mesh, law, fixed=bare.boundary.numpy(), prescribed=given, degree=degree, length=1.0,
        mean_dilatation=mean_dilatation,
    )  # fmt: skip
    force = body_force(problem, lambda x: at(load, x))
    answer = balanced(fem.Newton(problem), force).displacement[0].numpy()
    fine = skfem.Basis(mesh, problem.basis.elem, intorder=7)
    x = np.asarray(fine.global_coordinates())
    u, slope = at(exact, x), at(gradient, x)
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
    _draw_errors(folder / "order.png", found)
    return Section(
        "Order of accuracy",
        "independent code",
        "Manufactured solution u = 0.1 (sin πx cos πy/2, cos πy/2 sin πz, y sin πx/2 sin πz) on "
        "the unit cube (NH-ln, ν = 0.3). Tolerances: 5e-4 for errors of hexahedra, 10 % for "
        "tetrahedra, whose diagonals differ.",
        rows,
    )


def _draw_errors(path: Path, found: dict[tuple[str, int], Array]) -> None:
    panels = (
        ("L2 error of u [-]", ((0.125, 5.5e-4, 2), (0.21, 4.2e-5, 3))),
        ("H1 error of u (seminorm) [-]", ((0.14, 9e-3, 1), (0.3, 2e-3, 2))),
    )
    sizes = {"1": 1, "1/2": 1 / 2, "1/4": 1 / 4, "1/8": 1 / 8, "1/16": 1 / 16}
    log = {"xscale": "log", "yscale": "log"}
    with picture(path, 3.4) as figure:
        for place, (what, triangles) in enumerate(panels):
            ax = panel(figure, place + 1, "cell size h/L [-]", what, f"({'ab'[place]})", **log)
            for k, (kind, (counts, *printed)) in enumerate(ERRORS.items()):
                h, values = 1 / np.array(counts), [float(text) for text in printed[place].split()]
                measured(ax, h, found[kind][:, place], k, NAMES[kind])
                label = "independent code" if k == 3 else None
                reference(ax, h[-len(values) :], values, label)
            for x, y, power in triangles:
                triangle(ax, x, y, power)
            ax.set_xticks([*sizes.values()], [*sizes])
            ax.minorticks_off()
            if place == 0:
                ax.legend(loc="lower right")


SIDES = (2, 4, 8, 16, 32, 64)
COOK = {  # displacement u_y at (48, 52) [mm] on SIDES cells a side: deal.II
    1: "8.638 12.07 13.86 14.49 14.67 14.72",
    2: "14.30 14.65 14.71 14.73 14.74 14.74",
}
FINER = {1: "8.6384 12.0712 13.8632 14.4853", 2: "14.3018 14.6494 14.7139"}  # independent code
OTHERS: list[tuple[str, fem.Material, int, str]] = [  # 8 x 8 cells, independent code
    ("NH-ln", fem.NeoHookeanLn(0.3), 1, "13.700585"),
    ("NH-ln", fem.NeoHookeanLn(0.3), 2, "14.4831"),
    ("SVK", fem.SaintVenantKirchhoff(0.3), 2, "13.6261"),
]


def membrane(law: fem.Material, n: int, degree: int) -> tuple[fem.Problem, Tensor]:
    """Return Cook's membrane of n^2 cells in plane strain with its displacement [mm]."""
    problem, force = loaded_membrane(law, n, degree)
    return problem, balanced(fem.Newton(problem), force).displacement[0] * problem.length


def loaded_membrane(
    law: fem.Material, n: int, degree: int, *, cell: str = "quad", young: float = 0.4225 * 2.6,
    mean_dilatation: bool = False,
) -> tuple[fem.Problem, Tensor]:  # fmt: skip
    """Return Cook's membrane and the forces of a shear traction of 1/16 N/mm2 on the right.

    It has n cells a side, triangles in pairs. `young` is Young's modulus [N/mm2], by default of
    mu = 0.4225 N/mm2 and nu = 0.3.
    """
    mesh = fem.rectangle([1.0, 1.0], [n + 1, n + 1], cell)
    x, y = mesh.p
    mesh = type(mesh)(np.stack([48 * x, 44 * x + y * (44 - 28 * x)]), mesh.t)
    problem = fem.Problem.build(
        mesh, law, fixed=fem.Plane(0, "min"), degree=degree, mean_dilatation=mean_dilatation
    )
    return problem, fem.Traction(fem.Plane(0, "max"), [0.0, 1 / 16 / young]).on(problem)


def at(problem: fem.Problem, field: Tensor, place: Sequence[float]) -> tuple[float, ...]:
    """Return a nodal field (N, D) at the node nearest a place [of the unit of `length`]."""
    away = problem.points * problem.length - torch.tensor(place, dtype=torch.float64)
    return tuple(field[int(away.norm(dim=1).argmin())].tolist())


def cook(folder: Path) -> Section:
    """Refine Cook's membrane."""
    found = {(d, n): membrane(fem.NeoHookeanIsoK4(0.3), n, d) for d in COOK for n in SIDES}
    tips = {case: at(*body, (48, 52))[1] for case, body in found.items()}
    rows = []
    for source, table in (("deal.II", COOK), ("independent code", FINER)):
        for degree, printed in table.items():
            for n, text in zip(SIDES, printed.split(), strict=False):
                name = f"Q{degree}, {n} × {n}: u_y(48, 52) [mm], {source}"
                rows.append(Row(name, text, tips[degree, n]))
    for k, text in enumerate(("-13.8264", "13.7505")):
        name = f"Q2, 8 × 8: u_{'xy'[k]}(48, 60) [mm], independent code"
        rows.append(Row(name, text, at(*found[2, 8], (48, 60))[k]))
    for law_name, law, degree, text in OTHERS:
        name = f"{law_name}, Q{degree}, 8 × 8: u_y(48, 52) [mm], independent code"
        rows.append(Row(name, text, at(*membrane(law, 8, degree), (48, 52))[1]))
    _draw_membrane(folder / "cook.png", tips, *found[2, 8])
    return Section(
        "Cook's membrane",
        "deal.II",
        "deal.II's code gallery, *Quasi-static finite-strain compressible elasticity*, corrected "
        "2021: plane strain, clamped on the left, a dead shear traction of 1/16 N/mm² on the right "
        "(NHiso-k4, μ = 0.4225 N/mm², ν = 0.3). An independent code gives further digits and the "
        "other laws.",
        rows,
    )


def _draw_membrane(
    path: Path, tips: dict[tuple[int, int], float], problem: fem.Problem, u: Tensor
) -> None:
    with picture(path, 3.3) as figure:
        ax = panel(figure, 1, "cells a side [-]", "u$_y$ at (48, 52) [mm]", "(a)", xscale="log")
        for k, (degree, printed) in enumerate(COOK.items()):
            measured(ax, SIDES, [tips[degree, n] for n in SIDES], k, f"Q{degree}")
            known = [float(text) for text in printed.split()]
            reference(ax, SIDES, known, "deal.II" if k else None)
        ax.set_xticks(SIDES, map(str, SIDES))
        ax.minorticks_off()
        ax.legend(loc="lower right")
        ax = panel(figure, 2, "x [mm]", "y [mm]", "(b) Q2, 8 × 8 cells", aspect="equal")
        ax.grid(False)
        X = problem.points.numpy() * problem.length
        x, y = X.T
        nodes = lattice(np.stack([x / 48, (y - 44 / 48 * x) / (44 - 28 / 48 * x)], axis=1))
        side(ax, X, nodes, "0.6", 2)
        side(ax, X + u.numpy(), nodes, COLOURS[1], 2)
        tip = np.array([48.0, 52.0])
        ends = np.stack([tip, tip + at(problem, u, (48, 52))])
        ax.plot(*ends.T, "k.-", markersize=5, linewidth=0.8, zorder=5)
        ax.annotate("(48, 52)", ends[0], (5, -3), textcoords="offset points")
        ax.set(xticks=range(0, 61, 15), yticks=range(0, 76, 15), xlim=(-3, 66), ylim=(-3, 78))


POISSON = (0.3, 0.45, 0.49, 0.499, 0.4999)
LOCKING = {  # compliance over that of hex27, 16 x 4 x 4: cells, cell, degree, values
    "hex8, 16 × 4 × 4": ((16, 4, 4), "hexahedron", 1, ".960 .901 .753 .467 .209"),
    "tet4, 16 × 4 × 4": ((16, 4, 4), "tetra", 1, ".795 .615 .323 .103 .067"),
    "tet10, 8 × 2 × 2": ((8, 2, 2), "tetra", 2, ".991 .973 .957 .947 .945"),
    "hex27, 8 × 2 × 2": ((8, 2, 2), "hexahedron", 2, ".996 .981 .963 .954 .952"),
    "hex8 with mean dilatation, 16 × 4 × 4": ((16, 4, 4), "hexahedron", 1, ""),
    "tet10 with mean dilatation, 8 × 2 × 2": ((8, 2, 2), "tetra", 2, ""),
    "hex27 with mean dilatation, 8 × 2 × 2": ((8, 2, 2), "hexahedron", 2, ""),
}
RATIOS = (10.0, 1e2, 1e3, 1e4, 1e5)  # bulk over shear modulus
MOST_ITERATIONS = 10  # of Newton's method where they do not grow with the bulk modulus
BENT = {"hex8": ("hexahedron", 1), "hex27": ("hexahedron", 2), "tet10": ("tetra", 2)}


def compliance(
    nu: float, cells: Sequence[int], cell: str, degree: int, mean: bool = False
) -> float:
    """Return f u of the paper's beam under a small dead load across its end."""
    mesh = fem.box([4.0, 1.0, 1.0], [n + 1 for n in cells], cell)
    law = fem.NeoHookeanLn(nu)
    problem = fem.Problem.build(
        mesh, law, fixed=fem.Plane(0, "min"), degree=degree, mean_dilatation=mean
    )
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -1.0]).on(problem)
    return float((force * fem.LinearSolver(problem).solve(force)).sum())


def bending(ratio: float, cell: str, degree: int, *, mean: bool = True) -> tuple[float, int]:
    """Return the largest displacement of a cantilever 4 x 1 x 1, and the Newton iterations.

    A follower pressure of 0.004 E bends it by more than a third of its length. `ratio` is the bulk
    modulus over the shear modulus. The body consists of 12 x 3 x 3 hexahedra of degree 1, or of
    6 x 2 x 2 of degree 2 or six tetrahedra in each, with mean dilatation or without it.
    """
    counts = [13, 4, 4] if degree == 1 else [7, 3, 3]
    law = fem.NeoHookeanIsoK2((3 * ratio - 2) / (6 * ratio + 2))
    problem = fem.Problem.build(
        fem.box([4.0, 1.0, 1.0], counts, cell),
        law,
        fixed=fem.Plane(0, "min"),
        degree=degree,
        mean_dilatation=mean,
        follower_loads=[fem.FollowerPressure(fem.Plane(2, "max"), 0.004)],
        length=1.0,
    )
    solution = balanced(fem.Newton(problem, tol=1e-6))
    return float(solution.displacement.abs().max()), int(solution.iterations)


def locking(folder: Path) -> Section:
    """Measure the locking of every element towards incompressibility."""
    best = [compliance(nu, (16, 4, 4), "hexahedron", 2) for nu in POISSON]
    found, rows = {}, []
    for name, (cells, cell, degree, printed) in LOCKING.items():
        mean = not printed
        values = [compliance(nu, cells, cell, degree, mean) for nu in POISSON]
        found[name] = [value / right for value, right in zip(values, best, strict=True)]
        texts = printed.split() or ["> 0.94"] * len(POISSON)
        rows += [
            Row(f"{name}, ν = {nu}", text, value)
            for nu, text, value in zip(POISSON, texts, found[name], strict=True)
        ]
    for name, (cell, degree) in BENT.items():
        bent = [bending(ratio, cell, degree) for ratio in RATIOS]
        limit = bent[-1][0]
        for ratio, (size, count) in zip(RATIOS, bent, strict=True):
            title = f"{name} with mean dilatation bent far, κ/μ = {ratio:g}"
            rows.append(Row(f"{title}: Newton iterations", f"< {MOST_ITERATIONS}", count))
            within = 0.02  # the compressible body is softer
            rows.append(Row(f"{title}: largest displacement", f"{limit:.4f}", size, within))
    limit = compliance(POISSON[-1], (16, 4, 4), "hexahedron", 2, mean=True) / best[-1]
    plain = [str(bending(ratio, "hexahedron", 2, mean=False)[1]) for ratio in RATIOS]
    _draw_locking(folder / "locking.png", found)
    return Section(
        "Nearly incompressible bodies",
        "independent code",
        "Compliance of the paper's beam, relative to hex27 on 16 × 4 × 4 cells; elements that do "
        "not lock must exceed 0.94. A cantilever bent by a follower pressure of 0.004 E is "
        "compared with κ/μ = 1e5.",
        rows,
        "hex8 and tet4 lock; dpl warns of them. With `mean_dilatation` Newton's iterations do not "
        f"grow with the bulk modulus; without it hex27 needs {', '.join(plain)}. The hex27 of the "
        f"reference lock slightly: with `mean_dilatation` the same cells have {limit:.3f} times "
        f"their compliance at ν = {POISSON[-1]}.",
    )


def _draw_locking(path: Path, found: dict[str, list[float]]) -> None:
    with picture(path, 2.9) as figure:
        what = "compliance / that of fine hex27 [-]"
        ax = panel(
            figure,
            1,
            "Poisson's ratio ν [-], its distance from ½ in logarithmic scale",
            what,
            columns=1,
            xscale="log",
        )
        away = 0.5 - np.array(POISSON)
        elements = [name.split()[0].strip(",") for name in found]
        for element, (name, values) in zip(elements, found.items(), strict=True):
            dashed = {"linestyle": "--"} if "mean" in name else {}
            measured(ax, away, values, elements.index(element), name, **dashed)
            if known := [float(text) for text in LOCKING[name][3].split()]:
                reference(ax, away, known)
        reference(ax, [], [], "independent code")
        ax.set_xticks(away, map(str, POISSON))
        ax.minorticks_off()
        ax.invert_xaxis()
        ax.set(ylim=(0, 1.08))
        ax.legend(loc="upper left", bbox_to_anchor=(1, 1))

"""A column twisted by a right angle."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.study import picture
from benchmarks.verification.bodies import Array, balanced
from benchmarks.verification.drawing import curve, measured, panel, reference
from benchmarks.verification.report import Row, Section
from dpl.fem import DirichletBC, NeoHookeanLn, Newton, Plane, Problem, box
from dpl.visualization import draw_body

TWIST = {  # cells, degree: torque [N m], axial force [N], energy [J] at 90 degrees
    ((4, 4, 20), 1): ("18024.62786229", "-800.53818109", "14151.84978085"),
    ((2, 2, 10), 2): ("17404.618354", "-479.767061", "13664.649365"),
    ((4, 4, 20), 2): ("17150.398827", "-355.321678", "13462.158844"),
}
YOUNG, HEIGHT = 1e6, 5.0  # [Pa], [m]
TORSION = 0.140577  # torsion constant of the unit square [-], Timoshenko, Goodier (1951)


def twisted(
    cells: Sequence[int], degree: int, angles: Sequence[float]
) -> tuple[Array, Problem, Tensor]:
    """Return torque [N m], force [N] and energy [J] at angles (k, 3), body and last displacement.

    Each solve is started by the uniform twist, so that no load steps are needed.
    """
    mesh = box([1.0, 1.0, HEIGHT], [n + 1 for n in cells])
    ends = [DirichletBC(Plane(2, "min")), DirichletBC(Plane(2, "max"))]
    rest = Problem.build(mesh, NeoHookeanLn(0.3), supports=ends, degree=degree)
    X = rest.points - torch.tensor([0.5, 0.5, 0.0], dtype=torch.float64) / HEIGHT
    top, found, u = X[:, 2] > 1 - 1e-9, [], torch.zeros_like(X)
    for angle in angles:
        c, s = (angle * X[:, 2]).cos(), (angle * X[:, 2]).sin()
        turned = torch.stack([c * X[:, 0] - s * X[:, 1], s * X[:, 0] + c * X[:, 1], X[:, 2]], dim=1)
        moved = torch.where(rest.free, 0.0, turned - X)
        problem = replace(rest, prescribed=moved)
        u = balanced(Newton(problem, tol=1e-11), guess=(turned - X)[None]).displacement[0]
        f, x = problem.internal_force(u[None])[0, top], (X + u)[top]
        torque = float((x[:, 0] * f[:, 1] - x[:, 1] * f[:, 0]).sum())
        values = torque * HEIGHT, float(f[:, 2].sum()), float(problem.energy(u[None])) * HEIGHT
        found.append(YOUNG * HEIGHT**2 * np.array(values))
    return np.stack(found), rest, u


def twist(folder: Path) -> Section:
    """Twist a column by a right angle."""
    degrees = np.arange(10.0, 91.0, 10.0)
    rows, found = [], {}
    for (cells, degree), printed in TWIST.items():
        name = f"hex{8 if degree == 1 else 27}, {' × '.join(map(str, cells))}"
        found[name], body, u = twisted(cells, degree, np.radians(degrees).tolist())
        for k, what in enumerate(("torque [N m]", "axial force [N]", "energy [J]")):
            rows.append(Row(f"{name}: {what}", printed[k], float(found[name][-1, k]), 1e-8))
    _draw_twist(folder / "twist.png", degrees, found, body, u)
    torque, force = (rows[k].value / rows[k + 6].value for k in (0, 1))
    return Section(
        "Twisted column",
        "independent code",
        "The top of a column of 1 × 1 × 5 m (NH-ln, E = 1 MPa, ν = 0.3) is turned by 90° at "
        "constant height. Tolerance: 1e-8.",
        rows,
        f"hex8 differs from the finest mesh by {100 * (torque - 1):.0f} % in the torque and by a "
        f"factor of {force:.1f} in the axial force, an effect of second order.",
    )


def _draw_twist(
    path: Path, degrees: Array, found: dict[str, Array], body: Problem, u: Tensor
) -> None:
    with picture(path, 3.2) as figure:
        for k, (what, unit) in enumerate((("torque [kN m]", 1e-3), ("axial force [N]", 1.0))):
            ax = panel(figure, k + 1, "angle [°]", what, f"({'ab'[k]})", columns=3)
            for j, (name, values) in enumerate(found.items()):
                measured(ax, [0, *degrees], [0, *values[:, k] * unit], j, name)
            known = [float(printed[k]) * unit for printed in TWIST.values()]
            reference(ax, [90.0] * 3, known, "independent code")
            if k == 0:
                shear = YOUNG / 2.6 * TORSION * np.radians([0.0, 90.0]) / HEIGHT
                curve(ax, [0, 90], shear * unit, "Saint-Venant", linestyle="--")
            ax.legend(loc="upper left" if k == 0 else "lower left")
            ax.set_xticks([0, 30, 60, 90])
        ax = figure.add_subplot(1, 3, 3, projection="3d")
        draw_body(ax, body, u)
        ax.set_title("(c)", loc="left", y=1.1)

"""Stress at nodes of a bent beam and of a thick cylinder, against closed forms."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import skfem
import torch
from torch import Tensor

from benchmarks.study import picture
from benchmarks.verification.bodies import Array
from benchmarks.verification.drawing import measured, panel
from benchmarks.verification.report import Row, Section
from dpl import fem
from dpl.fem.postprocess import cauchy, von_mises

LOAD = 1e-6  # traction and pressure over E [-]: small strains
NU = 0.3


class Body(NamedTuple):
    """A solved body with its exact stress."""

    problem: fem.Problem  # the body
    stress: Tensor  # cauchy stress over E at the quadrature points, (1, E, Q, 3, 3) [-]
    exact: Tensor  # exact stress over E at the nodes, (N, 3, 3) [-]
    surface: Tensor  # mask of the nodes whose stress is compared, (N,)


def beam(cells: Sequence[int], cell: str, degree: int) -> Body:
    """Return a cantilever of 4 x 1 x 1 with nu = 0 and a transverse traction on its end.

    The surface consists of the nodes at z = 0 and z = 1 in the middle half of the length.
    """
    mesh = fem.box([4.0, 1.0, 1.0], [n + 1 for n in cells], cell)
    problem = fem.Problem.build(
        mesh, fem.LinearElastic(0.0), fixed=fem.Plane(0, "min"), degree=degree, length=1.0
    )
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, LOAD]).on(problem)
    u = fem.LinearSolver(problem).solve(force)
    x, _, z = problem.points.T
    z, inertia = z - 0.5, 1 / 12
    exact = torch.zeros(len(x), 3, 3, dtype=torch.float64)
    exact[:, 0, 0] = -LOAD * (4 - x) * z / inertia
    surface = (z.abs() > 0.5 - 1e-9) & ((x - 2).abs() < 1 + 1e-9)
    return Body(problem, cauchy(problem, u[None]), exact, surface)


def cylinder(cells: Sequence[int], cell: str, degree: int) -> Body:
    """Return a quarter of a cylinder under internal pressure, in plane strain, radii 1 and 2.

    Lame's displacement is prescribed on both radii. The surface is the inner one.
    """
    mesh = fem.rectangle([1.0, 1.0], [n + 1 for n in cells], cell)
    if degree == 2:
        mesh = {"triangle": skfem.MeshTri2, "quad": skfem.MeshQuad2}[cell].from_mesh(mesh)
    radius, angle = 1 + mesh.doflocs[0], np.pi / 2 * mesh.doflocs[1]
    mesh = replace(mesh, doflocs=radius * np.stack([np.cos(angle), np.sin(angle)]))
    build = partial(fem.Problem.build, mesh, fem.LinearElastic(NU), degree=degree, length=1.0)
    points = build().points.numpy()
    r = np.linalg.norm(points, axis=1, keepdims=True)
    k = LOAD / 3
    u = k * (1 + NU) * ((1 - 2 * NU) * points + 4 * points / r**2)
    fixed = points < 1e-9  # symmetry
    fixed |= (r < 1 + 1e-9) | (r > 2 - 1e-9)
    problem = build(fixed=fixed, prescribed=u)
    none = fem.Load(torch.zeros(1, *problem.shape, dtype=torch.float64), torch.ones(1))
    found = fem.solve(fem.Newton(problem), none).displacement
    exact = _lame(points, r, k)
    return Body(problem, cauchy(problem, found), exact, torch.from_numpy(r[:, 0] < 1 + 1e-9))


def _lame(points: Array, r: Array, k: float) -> Tensor:
    """Return the stress (N, 3, 3) of a cylinder of radii 1 and 2 (Lame 1852)."""
    n = points / r
    radial = n[:, :, None] * n[:, None, :]
    r = r[..., None]
    stress = np.zeros((len(points), 3, 3))
    stress[:, :2, :2] = k * ((1 + 4 / r**2) * np.eye(2) - 8 / r**2 * radial)
    stress[:, 2, 2] = 2 * NU * k
    return torch.from_numpy(stress)


def mean_of_cells(problem: fem.Problem, values: Tensor) -> Tensor:
    """Return the volume-weighted means (1, N, 3, 3) over the cells at each node."""
    dV = problem.dV.expand(len(problem.cells), -1)
    spread = (values[0] * dV[..., None, None]).sum(dim=1).flatten(1)  # (E, 9)
    total, volume = spread.new_zeros(problem.shape[0], 9), spread.new_zeros(problem.shape[0])
    for corner in problem.cells.T:
        total.index_add_(0, corner, spread)
        volume.index_add_(0, corner, dV.sum(dim=1))
    return (total / volume[:, None]).reshape(1, -1, 3, 3)


def patch_recovery(problem: fem.Problem, values: Tensor) -> Tensor:
    """Return nodal values (B, N, ...) of values at quadrature points, see `fem.fields`."""
    return problem.recovery(values)


def errors(body: Body, recover: Callable[[fem.Problem, Tensor], Tensor]) -> tuple[float, float]:
    """Return the rms error of the stress over its rms, and mean von Mises stress over the exact."""
    found, exact = recover(body.problem, body.stress)[0][body.surface], body.exact[body.surface]
    rms = (found - exact).square().sum((1, 2)).mean() / exact.square().sum((1, 2)).mean()
    return float(rms.sqrt()), float((von_mises(found) / von_mises(exact)).mean())


# name: body, cell, degree, cells; bound of the error
CASES: dict[str, tuple[Callable[..., Body], str, int, tuple[int, ...], float]] = {
    "beam, tet4": (beam, "tetra", 1, (16, 4, 4), 0.2),
    "beam, hex8": (beam, "hexahedron", 1, (16, 4, 4), 0.1),
    "beam, tet10": (beam, "tetra", 2, (8, 2, 2), 0.1),
    "beam, hex27": (beam, "hexahedron", 2, (8, 2, 2), 0.1),
    "cylinder, tri3": (cylinder, "triangle", 1, (8, 12), 0.1),
    "cylinder, quad4": (cylinder, "quad", 1, (8, 12), 0.1),
    "cylinder, tri6": (cylinder, "triangle", 2, (4, 6), 0.1),
    "cylinder, quad9": (cylinder, "quad", 2, (4, 6), 0.1),
}


RECOVERIES = {"means of cells": mean_of_cells, "patch recovery": patch_recovery}


def nodal_stress(folder: Path) -> Section:
    """Compare the stress at surfaces with closed forms."""
    rows, means, bodies = [], [], {}
    for name, (make, cell, degree, cells, bound) in CASES.items():
        bodies[name] = body = make(cells, cell, degree)
        error, ratio = errors(body, patch_recovery)
        error_of_mean, ratio_of_mean = errors(body, mean_of_cells)
        title = f"{name}, {' × '.join(map(str, cells))}"
        rows += [
            Row(f"{title}: rms error of the stress", f"< {bound}", error),
            Row(f"{title}: rms error over that of means", "< 0.8", error / error_of_mean),
            Row(f"{title}: von Mises stress over the exact one", "1", ratio, 0.15),
        ]
        means.append(ratio_of_mean)
    _draw(folder / "nodal_stress.png", bodies["beam, tet4"], bodies["cylinder, tri3"])
    return Section(
        "Stress at nodes",
        "σ = −M z/I; Lamé 1852",
        "Patch recovery (Zienkiewicz, Zhu 1992) at surface nodes of coarse meshes at small "
        "strains: a cantilever of 4 × 1 × 1 and a cylinder of radii 1 and 2 under internal "
        "pressure. Errors are root mean squares over those of the exact stress. Tolerance of the "
        "von Mises stress: 15 %.",
        rows,
        "Volume-weighted means of the cells, which dpl does not use, have "
        f"{min(means):.2f} to {max(means):.2f} of the exact von Mises stress. tet4 locks in "
        "bending.",
    )


def _draw(path: Path, bent: Body, pressed: Body) -> None:
    def curves(ax: Any, place: Tensor, part: Tensor, what: Callable[[Tensor], Tensor]) -> None:
        order = place[part].argsort()
        body = bent if ax is left else pressed
        x = place[part][order]
        ax.plot(x, what(body.exact)[part][order], color="black", linewidth=0.8, label="exact")
        for k, (name, recover) in enumerate(RECOVERIES.items()):
            values = what(recover(body.problem, body.stress)[0])[part][order]
            measured(ax, x, values, 1 - k, name)

    with picture(path, 2.9) as figure:
        left = panel(figure, 1, "z [-]", "σ$_{xx}$ / traction [-]", "(a) x = 2, y = 1/2")
        right = panel(figure, 2, "radius [-]", "von Mises stress / pressure [-]", "(b) at 45°")
        x, y, z = bent.problem.points.T
        middle = ((x - 2).abs() < 1e-9) & ((y - 0.5).abs() < 1e-9)
        curves(left, z, middle, lambda stress: stress[:, 0, 0] / LOAD)
        points = pressed.problem.points
        diagonal = (points[:, 0] - points[:, 1]).abs() < 1e-9
        curves(right, points.norm(dim=1), diagonal, lambda stress: von_mises(stress) / LOAD)
        left.legend()

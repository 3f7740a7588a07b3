"""Thick cylinder, thick sphere and a pneumatic finger under internal follower pressure."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from torch import Tensor

from benchmarks.study import picture
from benchmarks.verification.bodies import Array
from benchmarks.verification.drawing import measured, panel
from benchmarks.verification.report import Row, Section
from benchmarks.verification.ventricle import CURVED
from dpl import fem

INNER, OUTER = 1.0, 2.0  # radii [m]
FINGER = (160.0, 16.0, 16.0)  # sides of the finger [mm]
FINGER_PRESSURE = 0.08  # over E [-]
# nu -> name -> dimension, pressure over E, cells, degree, numbers of cells, bound of the error
CASES: dict[float, dict[str, tuple[int, float, str, int, tuple[int, ...], float]]] = {
    0.3: {
        "cylinder, quad9": (2, 0.15, "quad", 2, (2, 4, 8, 16), 1e-6),
        "cylinder, quad4": (2, 0.15, "quad", 1, (8, 16, 32), 1e-2),
        "sphere, hex27": (3, 0.2, "hexahedron", 2, (1, 2, 3, 4), 1e-3),
    },
    0.49: {"cylinder, quad9": (2, 0.15, "quad", 2, (2, 4, 8, 16), 1e-5)},
}


def expanded_radius(nu: float, pressure: float, dim: int) -> float:
    """Return r(A) / A of a thick cylinder (dim 2, plane strain) or sphere (dim 3), NH-ln, E = 1.

    Shooting on the equation of radial equilibrium, dP_r/dR = (dim - 1) (P_t - P_r) / R, with the
    principal stresses P_i = mu (l_i - 1/l_i) + lambda ln(J) / l_i of the stretches l_r = dr/dR and
    l_t = r/R; the inner surface has P_r = -p l_t^(dim - 1), the outer one P_r = 0.
    """
    mu, lam = 1 / (2 * (1 + nu)), nu / ((1 + nu) * (1 - 2 * nu))
    k = dim - 1

    def stress(own: float, radial: float, hoop: float) -> float:
        return mu * (own - 1 / own) + lam * (math.log(radial) + k * math.log(hoop)) / own

    def slope(R: float, state: Array) -> list[float]:
        r, radial = state
        hoop = r / R
        log_j = math.log(radial) + k * math.log(hoop)
        change = (radial - hoop) / R  # of the hoop stretch
        along = mu * (1 + 1 / radial**2) + lam * (1 - log_j) / radial**2
        rest = lam * k * change / (hoop * radial)
        pull = k * (stress(hoop, radial, hoop) - stress(radial, radial, hoop)) / R
        return [radial, (pull - rest) / along]

    def outer_stress(hoop: float) -> float:
        radial = brentq(
            lambda x: stress(x, x, hoop) + pressure * hoop**k, 1e-2, 5.0, xtol=1e-15, rtol=1e-15
        )
        options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15}
        path = solve_ivp(slope, (INNER, OUTER), [hoop * INNER, radial], **options)
        r, radial = path.y[:, -1]
        return stress(radial, radial, r / OUTER)

    first = 1 + pressure  # between no expansion and one past the solution
    step = 0.05
    while outer_stress(first + step) * outer_stress(1.0) > 0:
        step += 0.05
    return float(brentq(outer_stress, 1.0, first + step, xtol=1e-14, rtol=1e-14))


def sector(dim: int, cells: int, shape: str, *, quadratic: bool) -> skfem.Mesh:
    """Return a quarter of the cylinder, or an octant of the sphere; `cells` through the wall."""
    if dim == 2:
        mesh = fem.rectangle([1.0, 1.0], [cells + 1, 2 * cells + 1], shape)
        if quadratic:
            mesh = {"triangle": skfem.MeshTri2, "quad": skfem.MeshQuad2}[shape].from_mesh(mesh)
        radius, angle = INNER + mesh.doflocs[0], np.pi / 2 * mesh.doflocs[1]
        return replace(mesh, doflocs=radius * np.stack([np.cos(angle), np.sin(angle)]))
    # coordinates: radius and two of a side of a cube
    patch = fem.box([1.0] * 3, [cells + 1] * 3, shape)
    radius = INNER + patch.p[0]
    at = radius * np.stack([patch.p[1], patch.p[2], np.ones_like(radius)])
    parts = [type(patch)(np.roll(at, k, axis=0), patch.t) for k in range(3)]
    mesh = parts[0] + parts[1] + parts[2]
    mesh = CURVED[type(mesh)].from_mesh(mesh) if quadratic else mesh
    x = mesh.doflocs
    return replace(mesh, doflocs=x * x.max(axis=0) / np.linalg.norm(x, axis=0))


def inner_surface(points: Array) -> NDArray[np.bool_]:
    """Return a mask of the nodes at the inner radius."""
    return np.linalg.norm(points, axis=1) < INNER + 1e-9


def expansion(nu: float, pressure: float, mesh: skfem.Mesh, degree: int, **options: Any) -> float:
    """Return r(A) / A of a sector with symmetry conditions: the mean over the inner surface."""
    build = partial(
        fem.Problem.build, mesh, fem.NeoHookeanLn(nu), degree=degree, length=1.0, **options
    )
    points = build().points.numpy()
    inflate = fem.FollowerPressure(inner_surface, pressure)
    problem = build(fixed=points < 1e-9, follower_loads=[inflate])
    u = under_pressure(problem, 1.0).displacement[0]
    assert problem.follower_loads is not None
    # the volume that the surface has passed, from its current radius
    volume = -float(problem.follower_loads.work(u[None])) / pressure
    dim, part = mesh.dim(), {2: math.pi / 4, 3: math.pi / 6}[mesh.dim()]
    return (volume / part / INNER**dim + 1) ** (1 / dim)


def under_pressure(problem: fem.Problem, factor: float, tol: float = 1e-10) -> fem.Solution:
    """Return the equilibrium under a part of the pressure and no other load."""
    newton = fem.Newton(problem.under(factor), tol=tol)
    found = fem.solve(newton, fem.Load(torch.zeros(1, *problem.shape).double(), torch.ones(1)))
    assert found.converged.all(), str(fem.Status(int(found.status)))
    return found


def energy_balance(
    cells: Sequence[int], pressure: float = FINGER_PRESSURE, points: int = 6
) -> tuple[float, float, float]:
    """Return strain energy and work of `dpl.fem.finger`, over E L^3, and the tip's deflection / L.

    The finger is fixed at x = 0. The work of the whole pressure, the integral of p dV, is p V minus
    the integral of V dp by Gauss points of the pressure.
    """
    problem = fem.Problem.build(
        fem.finger(FINGER, cells),
        fem.NeoHookeanLn(0.4),
        fixed=fem.Plane(0, "min"),
        mean_dilatation=True,
        follower_loads=[fem.FollowerPressure(fem.Tag("chamber"), pressure)],
    )
    surface = problem.follower_loads
    assert surface is not None

    def volume(u: Tensor) -> float:
        """Increase of the volume of the chamber times the pressure."""
        return -float(surface.work(u))

    nodes, weights = np.polynomial.legendre.leggauss(points)
    inner = [volume(under_pressure(problem, x).displacement) for x in (nodes + 1) / 2]
    u = under_pressure(problem, 1.0).displacement
    strain = float(problem.tensors.energy(u))
    tip = u[0, problem.points[:, 0] > problem.points[:, 0].max() - 1e-9].mean(dim=0)
    return strain, volume(u) - float(weights @ inner) / 2, float(tip.norm())


def inflation(folder: Path) -> Section:
    """Compare inflated bodies with the radial solution, and work with strain energy."""
    rows, curves = [], {}
    for nu, cases in CASES.items():
        for name, (dim, pressure, shape, degree, counts, bound) in cases.items():
            exact = expanded_radius(nu, pressure, dim)
            found = [
                expansion(nu, pressure, sector(dim, n, shape, quadratic=degree == 2), degree)
                for n in counts
            ]
            errors = [abs(x / exact - 1) for x in found]
            order = math.log(errors[-2] / errors[-1]) / math.log(counts[-1] / counts[-2])
            share = (counts[-1] / counts[-2]) ** (2 * degree)
            limit = (share * found[-1] - found[-2]) / (share - 1)
            title = f"{name}, ν = {nu:g}, p = {pressure:g} E"
            rows += [
                Row(f"{title}: r/R, {counts[-1]} cells", f"{exact:.7f}", found[-1], bound),
                Row(f"{title}: order of the error", f"{2 * degree}", order, 0.25),
                Row(f"{title}: r/R, extrapolated", f"{exact:.9f}", limit, bound / 10),
            ]
            curves[title] = counts, errors
    strain, work, tip = energy_balance((20, 4, 8))
    title = "finger, 20 × 4 × 8 hex8"
    rows += [
        Row(f"{title}: ∫ p dV over the strain energy", "1", work / strain, 1e-7),
        Row(f"{title}: deflection of the tip over L", "> 0.1", tip),
    ]
    _draw(folder / "inflation.png", curves)
    return Section(
        "Follower pressure",
        "radial equilibrium, shooting to 12 digits",
        "A cylinder and a sphere of radii 1 and 2 (NH-ln), r/R of the inner radius; *extrapolated* "
        "are the last two meshes (Richardson). The finger of 160 × 16 × 16 mm has a closed "
        "chamber.",
        rows,
    )


def _draw(path: Path, curves: Mapping[str, tuple[Sequence[int], list[float]]]) -> None:
    with picture(path, 2.9) as figure:
        axes = panel(figure, 1, "cells through the wall", "relative error of r/R [-]", "")
        for k, (name, (counts, errors)) in enumerate(curves.items()):
            measured(axes, counts, errors, k, name)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1))

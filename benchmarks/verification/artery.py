"""Artery of two layers under internal follower pressure, in plane strain."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.optimize import brentq

from benchmarks.study import picture
from benchmarks.verification.bodies import Array, balanced
from benchmarks.verification.drawing import measured, panel
from benchmarks.verification.report import Row, Section
from dpl import fem

INNER, MIDDLE, OUTER = 1.0, 1.5, 2.0  # radii [mm]
BULKS = (1e2, 1e4, 1e6)  # bulk over shear modulus of each layer [-]
TOL = 1e-7  # relative residual; rounding allows no less at the largest bulk modulus
CELLS = ((4, 16), (8, 32), (16, 64))  # through the wall and around a quarter


@dataclass(frozen=True)
class Layer:
    """Neo-Hookean layer with two families of fibres."""

    mu: float  # shear modulus of the matrix [kPa]
    k1: float = 0.0  # modulus of the fibres [kPa]; 0: none
    k2: float = 1.0  # exponent of the fibres [-]
    kappa: float = 0.0  # dispersion of the fibres [-]
    angle: float = 0.0  # angle between fibres and circumference [rad]

    def pull(self, hoop: float) -> float:
        """Return dW/d(hoop) [kPa] at the stretches 1/hoop, hoop and 1."""
        change = hoop - hoop**-3  # half of dI1 / d(hoop)
        axial, cos2 = 1 - 3 * self.kappa, math.cos(self.angle) ** 2
        strain = self.kappa * (hoop - 1 / hoop) ** 2 + axial * cos2 * (hoop**2 - 1)
        slope = 2 * (self.kappa * change + axial * cos2 * hoop)
        if strain < 0:
            return self.mu * change
        return self.mu * change + 2 * self.k1 * strain * math.exp(self.k2 * strain**2) * slope

    def law(self, bulk: float) -> fem.Material:
        """Return the law with a bulk modulus over mu."""
        nu = (3 * bulk - 2) / (2 * (3 * bulk + 1))
        matrix = fem.NeoHookeanIsoK4(nu, young=2 * self.mu * (1 + nu))
        if not self.k1:
            return matrix
        fibres = fem.HolzapfelGasserOgdenFibres(self.k1, self.k2, self.kappa, self.angle)
        return fem.FibreReinforced(matrix, fibres, fem.FibreFunction(_hoop_and_axis))


# constants of the order of those of Holzapfel, Gasser, Ogden (2000), tables 1 and 2
ARTERIES: dict[str, tuple[dict[str, Layer], float]] = {
    "neo-Hookean": ({"media": Layer(30.0), "adventitia": Layer(6.0)}, 10.0),
    "Holzapfel-Gasser-Ogden": (
        {
            "media": Layer(3.0, 2.4, 0.84, 0.0, math.radians(29)),
            "adventitia": Layer(0.3, 0.56, 0.71, 0.1, math.radians(62)),
        },
        3.0,
    ),
}


def exact_radius(layers: Mapping[str, Layer], pressure: float) -> float:
    """Return r(A) / A of an incompressible artery under a pressure [kPa].

    The points move as r^2 = R^2 + c. Radial equilibrium gives p, the integral of dW/d(hoop) / r
    over R through both layers; c is the root of this equation.
    """

    def excess(c: float) -> float:
        def at(R: float, layer: Layer) -> float:
            r = math.sqrt(R**2 + c)
            return layer.pull(r / R) / r

        spans = zip(layers.values(), ((INNER, MIDDLE), (MIDDLE, OUTER)), strict=True)
        parts = (quad(partial(at, layer=one), *span, epsabs=0, epsrel=1e-12) for one, span in spans)
        return sum(value for value, _ in parts) - pressure

    c = float(brentq(excess, 0.0, 4.0, xtol=1e-14, rtol=1e-14))
    return math.sqrt(INNER**2 + c) / INNER


def wall(cells: Sequence[int]) -> skfem.Mesh:
    """Return a quarter of the wall, of quadratic quadrilaterals; its layers are subdomains."""
    mesh = fem.rectangle([1.0, 1.0], [n + 1 for n in cells])
    inside = mesh.p[0, mesh.t].mean(axis=0) < (MIDDLE - INNER) / (OUTER - INNER)
    mesh = skfem.MeshQuad2.from_mesh(mesh)
    radius, angle = INNER + (OUTER - INNER) * mesh.doflocs[0], np.pi / 2 * mesh.doflocs[1]
    layers = {"media": np.flatnonzero(inside), "adventitia": np.flatnonzero(~inside)}
    places = radius * np.stack([np.cos(angle), np.sin(angle)])
    return skfem.MeshQuad2(places, mesh.t).with_subdomains(layers)


def radius(
    layers: Mapping[str, Layer], pressure: float, cells: Sequence[int], bulk: float
) -> float:
    """Return r(A) / A for a ratio of bulk to shear modulus, the mean over the inner nodes."""
    problem = fem.Problem.build(
        wall(cells),
        {name: layer.law(bulk) for name, layer in layers.items()},
        supports=[
            fem.DirichletBC(fem.Plane(0, 0.0), [0.0, None]),
            fem.DirichletBC(fem.Plane(1, 0.0), [None, 0.0]),
        ],
        follower_loads=[fem.FollowerPressure(_inside, pressure)],
        mean_dilatation=True,
        length=1.0,
    )
    places = problem.points.numpy() + problem.origin
    inner = _inside(places)
    displacement = balanced(fem.Newton(problem, tol=TOL)).displacement[0].numpy()
    return float(np.linalg.norm(places[inner] + displacement[inner], axis=1).mean()) / INNER


def _inside(points: Array) -> NDArray[np.bool_]:
    return np.linalg.norm(points, axis=1) < INNER + 1e-9


def _hoop_and_axis(points: Array) -> tuple[Array, Array]:
    x, y = points.T
    zero = np.zeros_like(x)
    return np.stack([-y, x, zero], axis=1), np.stack([zero, zero, zero + 1], axis=1)


def artery(folder: Path) -> Section:
    """Compare the inflation of two arteries with the integral of radial equilibrium."""
    rows, curves = [], {}
    for name, (layers, pressure) in ARTERIES.items():
        exact = exact_radius(layers, pressure)
        for cells in CELLS:
            found = [radius(layers, pressure, cells, bulk) for bulk in BULKS]
            title = f"{name}, {cells[0]} × {cells[1]} quad9"
            curves[title] = [abs(x / exact - 1) for x in found]
            for bulk, x in list(zip(BULKS, found, strict=True))[0 if cells == CELLS[-1] else -1 :]:
                within = 5e-6 if cells == CELLS[-1] and bulk == BULKS[-1] else 1e-2
                rows.append(Row(f"{title}, κ/μ = {bulk:g}: r/R", f"{exact:.6f}", x, within))
    with picture(folder / "artery.png", 2.9) as figure:
        axes = panel(figure, 1, "κ / μ [-]", "relative error of r/R [-]", "", columns=1)
        for k, (name, errors) in enumerate(curves.items()):
            measured(axes, BULKS, errors, k, name)
        axes.set(xscale="log", yscale="log")
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return Section(
        "Artery of two layers",
        "incompressible tube, one integral over the wall",
        "Media and adventitia of 0.5 mm each in plane strain: neo-Hookean layers under 10 kPa, and "
        "fibres (Gasser, Ogden, Holzapfel 2006) under 3 kPa, `mean_dilatation`. Tolerances: 5e-6 "
        "for the finest mesh with the largest bulk modulus, else 1 %.",
        rows,
    )

"""Bodies and loads of the stress cases and of the tests of the mechanics."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.verification.bodies import Array, paper_beam, slender
from benchmarks.verification.rods import pushed
from dpl import fem

YOUNG = 4500.0  # of the paper's beam [Pa]
MAX_TRACTION = 40.0  # traction on its end that bounds the training range [Pa]
ELEMENTS = [(cell, d) for cell in ("triangle", "quad", "tetra", "hexahedron") for d in (1, 2)]
RUBBER = fem.YeohK2(0.5, -0.25, 0.025, 1e6)  # nearly incompressible


def as_load(force: Tensor) -> fem.Load:
    """Return nodal forces (N, D) [-] as a batch of one load with E = 1 Pa."""
    return fem.Load(force[None], torch.ones(1, dtype=torch.float64))


def end_traction(problem: fem.Problem, q: float) -> Tensor:
    """Return the nodal forces (N, D) [-] of a dead traction -q [Pa] on the end x = max."""
    down = [0.0] * (problem.shape[1] - 1) + [-q / YOUNG]
    return fem.Traction(fem.Plane(0, "max"), down).on(problem)


def coarse_beam(cell: str, degree: int, law: fem.Material) -> fem.Problem:
    """Return the paper's beam, 100 x 25 (x 25) m, with 8 x 2 (x 2) cells."""
    return paper_beam(law, (8, 2) if cell in ("triangle", "quad") else (8, 2, 2), cell, degree)


def plate(
    sides: int, layers: int, degree: int, slenderness: int
) -> tuple[fem.Problem, Tensor, float]:
    """Return a clamped square plate of side 1, a uniform load and Kirchhoff's deflection.

    Deflection of the centre: 0.00126532 q a^4 / D. Source: Timoshenko, Woinowsky-Krieger (1959),
    table 35.
    """
    height, load = 1 / slenderness, 1e-9
    mesh = fem.box([1.0, 1.0, height], [sides + 1, sides + 1, layers + 1])

    def rim(x: Array) -> NDArray[np.bool_]:
        return np.any((x[:, :2] < 1e-9) | (x[:, :2] > 1 - 1e-9), axis=1)

    problem = fem.Problem.build(mesh, fem.LinearElastic(0.3), fixed=rim, degree=degree)
    force = fem.Traction(fem.Plane(2, "max"), [0.0, 0.0, -load]).on(problem)
    return problem, force, 0.00126532 * load * 12 * (1 - 0.3**2) / height**3


def nearest_node(problem: fem.Problem, place: list[float]) -> int:
    """Return the node nearest to a place over L [-]."""
    return int((problem.points - torch.tensor(place, dtype=torch.float64)).norm(dim=1).argmin())


UNDERCONSTRAINED = {  # support -> region and the words of the error
    "free": (None, "6 rigid modes are unconstrained: translation along x"),
    "hinge": (fem.Box([0, 0, 0], [0, 1, 0]), "1 rigid modes are unconstrained: rotation about y"),
}


def column(law: fem.Material, cells: tuple[int, int, int]) -> tuple[fem.Problem, Tensor]:
    """Return a column of 10 x 1 x 1 m in hex27, E = 1000 Pa, and an axial load of 1 N."""
    problem = slender(law, cells)
    return problem, pushed(problem, 1.0)


def bent_column(problem: fem.Problem, angle: float, side: float = 1.0) -> Tensor:
    """Return a bent column whose section angles are a quarter sine up to `angle`, (1, N, 3)."""
    along = torch.linspace(0, 1, 2001, dtype=torch.float64)
    turn = angle * (np.pi / 2 * along).sin()
    x, y, z = problem.points.T
    height = z - z.max() / 2

    def at(values: Tensor) -> Tensor:
        return torch.from_numpy(np.interp(x.numpy(), along.numpy(), values.numpy()))

    line = [torch.cumulative_trapezoid(f, along) for f in (turn.cos(), turn.sin())]
    axis, rise = (at(torch.nn.functional.pad(f, (1, 0))) for f in line)
    t = at(turn)
    bent_beam = [axis - side * height * t.sin(), y, side * rise + height * t.cos() + z.max() / 2]
    return (torch.stack(bent_beam, dim=1) - problem.points)[None]


def cube(
    law: fem.Material, cells: int = 1, axes: tuple[int, ...] = (0,)
) -> tuple[fem.Problem, Tensor]:
    """Return a unit cube on three symmetry planes and unit tractions on the opposite faces."""
    mesh = fem.box([1.0, 1.0, 1.0], [cells + 1] * 3)
    problem = fem.Problem.build(mesh, law, fixed=mesh.p.T == 0, length=1.0)
    eye = torch.eye(3).tolist()
    loads = [fem.Traction(fem.Plane(axis, "max"), eye[axis]).on(problem) for axis in axes]
    return problem, torch.stack(loads).sum(dim=0)


def uniaxial_stretch(problem: fem.Problem, stretch: float) -> Tensor:
    """Return the isochoric uniaxial stretch along x, (1, N, 3) [-]."""
    sides = torch.tensor([stretch, stretch**-0.5, stretch**-0.5], dtype=torch.float64)
    return (problem.points * (sides - 1))[None]


def equitriaxial_stretch(problem: fem.Problem, stretch: float) -> tuple[Tensor, float]:
    """Return an equitriaxial stretch of a cube, (1, N, 3) [-], and its traction T / E."""
    H = (stretch - 1) * torch.eye(3, dtype=torch.float64)
    return ((stretch - 1) * problem.points)[None], problem.material.stress(H)[0, 0].item()

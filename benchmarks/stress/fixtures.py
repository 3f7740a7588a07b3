"""Bodies and loads of the stress cases; the tests of the mechanics build them here too."""

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.verification.bodies import Array
from dpl.fem import (
    Box,
    LinearElastic,
    Load,
    Material,
    NeoHookeanLn,
    Plane,
    Problem,
    Traction,
    YeohK2,
    box,
    rectangle,
)

YOUNG = 4500.0  # of the paper's beam [Pa]
LARGEST = 40.0  # traction on its end that counts as the end of the training range [Pa]
KINDS = [(cell, d) for cell in ("triangle", "quad", "tetra", "hexahedron") for d in (1, 2)]
RUBBER = YeohK2(0.5, -0.25, 0.025, 1e6)  # VERIFICATION 1.8h; its bulk modulus stands for infinity


def load_of(force: Tensor) -> Load:
    """Return nodal forces (N, D) [-] as a load of one member; no answer depends on its modulus."""
    return Load(force[None], torch.ones(1, dtype=torch.float64))


def pulled(problem: Problem, q: float) -> Tensor:
    """Return the forces (N, D) [-] of a dead traction q [Pa] down the end x = max of the beam."""
    down = [0.0] * (problem.shape[1] - 1) + [-q / YOUNG]
    return Traction(Plane(0, "max"), down).on(problem)


def beam_of(cell: str, degree: int, law: Material) -> Problem:
    """Return the paper's beam, 100 x 25 (x 25) m, in 8 x 2 (x 2) of any cells."""
    flat = cell in ("triangle", "quad")
    sizes, nodes = [100.0, 25.0, 25.0], [9, 3, 3]
    mesh = rectangle(sizes[:2], nodes[:2], cell) if flat else box(sizes, nodes, cell)
    return Problem.build(mesh, law, fixed=Plane(0, "min"), degree=degree)


def slivers(part: float) -> skfem.Mesh:
    """Return the beam of 8 x 2 x 2 cells, its plane x = 50 m moved to 37.5 + 12.5 part."""
    mesh = box([100.0, 25.0, 25.0], [9, 3, 3])
    points = mesh.p.copy()
    points[0, points[0] == 50.0] = 37.5 + 12.5 * part
    return skfem.MeshHex(points, mesh.t)


def plate(sides: int, layers: int, degree: int, slenderness: int) -> tuple[Problem, Tensor, float]:
    """Return a square plate of side 1, clamped all around, an even load, and Kirchhoff's answer.

    Source of the answer, the deflection of the centre: 0.00126532 q a^4 / D, Timoshenko,
    Woinowsky-Krieger (1959), table 35.

    Args:
        sides: Cells along a side.
        layers: Cells through the thickness.
        degree: Of the displacement.
        slenderness: Side over thickness.
    """
    height, load = 1 / slenderness, 1e-9
    mesh = box([1.0, 1.0, height], [sides + 1, sides + 1, layers + 1])

    def rim(x: Array) -> NDArray[np.bool_]:
        return np.any((x[:, :2] < 1e-9) | (x[:, :2] > 1 - 1e-9), axis=1)

    problem = Problem.build(mesh, LinearElastic(0.3), fixed=rim, degree=degree)
    force = Traction(Plane(2, "max"), [0.0, 0.0, -load]).on(problem)
    return problem, force, 0.00126532 * load * 12 * (1 - 0.3**2) / height**3


def nearest_node(problem: Problem, place: list[float]) -> int:
    """Return the node nearest to a place over L [-]."""
    return int((problem.points - torch.tensor(place, dtype=torch.float64)).norm(dim=1).argmin())


LOOSE = {  # support -> rigid motions that it leaves
    "free": (None, "6 rigid modes are unconstrained: translation along x"),
    "hinge": (Box([0, 0, 0], [0, 1, 0]), "1 rigid modes are unconstrained: rotation about y"),
}


def loose(support: str) -> Problem:
    """Return a bar 4 x 1 x 1 m that is held by less than it takes, see `LOOSE`."""
    mesh = box([4.0, 1.0, 1.0], [5, 2, 2])
    return Problem.build(mesh, NeoHookeanLn(0.3), fixed=LOOSE[support][0])


def folded() -> skfem.Mesh:
    """Return a cube of 2 x 2 x 2 cells, its middle node pulled through a side of four of them."""
    mesh = box([1.0, 1.0, 1.0], [3, 3, 3])
    points = mesh.p.copy()
    points[:, (points == 0.5).all(axis=0)] = [[1.4], [0.5], [0.5]]
    return skfem.MeshHex(points, mesh.t)


def column(law: Material, cells: tuple[int, int, int]) -> tuple[Problem, Tensor]:
    """Return the column of VERIFICATION 1.8g, 10 x 1 x 1 m in hex27, E = 1000 Pa, and P = 1 N."""
    mesh = box([10.0, 1.0, 1.0], [n + 1 for n in cells])
    problem = Problem.build(mesh, law, fixed=Plane(0, "min"), degree=2)
    return problem, Traction(Plane(0, "max"), [-1 / 1000, 0.0, 0.0]).on(problem)


def bowed(problem: Problem, angle: float, side: float = 1.0) -> Tensor:
    """Return the column bent to a quarter sine of section angles, `angle` at its end, (1, N, 3)."""
    along = torch.linspace(0, 1, 2001, dtype=torch.float64)
    turn = angle * (np.pi / 2 * along).sin()
    x, y, z = problem.points.T
    height = z - z.max() / 2

    def at(values: Tensor) -> Tensor:
        return torch.from_numpy(np.interp(x.numpy(), along.numpy(), values.numpy()))

    line = [torch.cumulative_trapezoid(f, along) for f in (turn.cos(), turn.sin())]
    axis, rise = (at(torch.nn.functional.pad(f, (1, 0))) for f in line)
    t = at(turn)
    bent = [axis - side * height * t.sin(), y, side * rise + height * t.cos() + z.max() / 2]
    return (torch.stack(bent, dim=1) - problem.points)[None]


def cube(law: Material, cells: int = 1, axes: tuple[int, ...] = (0,)) -> tuple[Problem, Tensor]:
    """Return a unit cube that slides on three planes, and unit loads along axes on the others."""
    mesh = box([1.0, 1.0, 1.0], [cells + 1] * 3)
    problem = Problem.build(mesh, law, fixed=mesh.p.T == 0, length=1.0)
    eye = torch.eye(3).tolist()
    loads = [Traction(Plane(axis, "max"), eye[axis]).on(problem) for axis in axes]
    return problem, torch.stack(loads).sum(dim=0)


def stretched(problem: Problem, stretch: float) -> Tensor:
    """Return the uniaxial stretch along x that keeps the volume, (1, N, 3) [-]."""
    sides = torch.tensor([stretch, stretch**-0.5, stretch**-0.5], dtype=torch.float64)
    return (problem.points * (sides - 1))[None]


def swollen(problem: Problem, stretch: float) -> tuple[Tensor, float]:
    """Return the state (1, N, 3) of a cube, equally stretched, and the load T / E on its sides."""
    H = (stretch - 1) * torch.eye(3, dtype=torch.float64)
    return ((stretch - 1) * problem.points)[None], problem.material.stress(H)[0, 0].item()

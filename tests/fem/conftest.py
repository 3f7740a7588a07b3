"""Laws, small bodies and loads that the tests of the mechanics share."""

from collections.abc import Callable

import numpy as np
import pytest
import skfem
import torch
from laws import LAWS
from solving import KINDS, LENGTH, YOUNG
from torch import Tensor

from dpl import fem
from dpl.fem.linear import SuperLU
from dpl.fem.loads import traction


@pytest.fixture(params=[fem.SaintVenantKirchhoff, fem.NeoHookeanLn], ids=["svk", "neo-hookean"])
def law(request) -> fem.Material:
    """The two laws of the tables for bodies, at a Poisson ratio of 0.3."""
    return request.param(0.3)


@pytest.fixture(scope="session")
def laws() -> dict[str, fem.Material]:
    """All laws by name."""
    return LAWS


@pytest.fixture(params=[False, True], ids=["plain", "mixed"])
def mixed(request) -> bool:
    """Both kinds of Newton: without and with mixed integration points."""
    return request.param


@pytest.fixture(params=KINDS, ids=lambda kind: f"{kind[0]}{kind[1]}")
def kind(request) -> tuple[str, int]:
    """Shape of the cell and degree of the displacement: all eight elements."""
    return request.param


@pytest.fixture(scope="session")
def grid() -> Callable[..., skfem.Mesh]:
    """Grids of unit size, `count` cells a side, their vertices shaken by a part of the cell."""

    def grid(cell: str, count: int = 2, shaken: float = 0.0, *, inside: bool = False) -> skfem.Mesh:
        build, dim = (fem.box, 3) if cell in ("tetra", "hexahedron") else (fem.rectangle, 2)
        mesh = build([1.0] * dim, [count + 1] * dim, cell)
        shift = np.random.default_rng(7).uniform(-shaken / count, shaken / count, mesh.p.shape)
        if inside:  # the boundary stays where it is
            shift[:, mesh.boundary_nodes()] = 0.0
        return type(mesh)(mesh.p + shift, mesh.t)

    return grid


@pytest.fixture(scope="session")
def chain() -> Callable[..., skfem.Mesh]:
    """Rows of `count` equal cells of unit size along x, neighbours with nodes in common."""

    def chain(cell: str, count: int) -> skfem.Mesh:
        dim = 3 if cell in ("tetra", "hexahedron") else 2
        if cell in ("quad", "hexahedron"):
            build = fem.box if dim == 3 else fem.rectangle
            return build([count, *[1.0] * (dim - 1)], [count + 1, *[2] * (dim - 1)], cell)
        spine = np.pad(np.arange(count + 1.0)[:, None], ((0, 0), (0, dim - 1)))
        tips = [spine[:-1] + axis for axis in np.eye(dim)[1:]]
        numbers = np.arange(count)
        corners = [numbers, numbers + 1, *(numbers + 1 + count * k for k in range(1, dim))]
        build = skfem.MeshTet if dim == 3 else skfem.MeshTri
        return build(np.concatenate([spine, *tips]).T.copy(), np.stack(corners))

    return chain


@pytest.fixture(scope="session")
def bend() -> Callable[..., Tensor]:
    """Random smooth displacements (B, N, D) of points (N, D) that invert nothing."""

    def bend(points: Tensor, batch: int = 1, seed: int = 0) -> Tensor:
        random, dim = torch.Generator().manual_seed(seed), points.shape[1]

        def uniform(*shape: int) -> Tensor:
            return 2 * torch.rand(*shape, generator=random, dtype=torch.float64) - 1

        waves = (points @ uniform(batch, dim, dim) * 2 + uniform(batch, 1, dim)).sin()
        return points @ uniform(batch, dim, dim) * 0.12 + 0.05 * waves

    return bend


@pytest.fixture(scope="session")
def beam() -> Callable[..., fem.Problem]:
    """The beam 100 x 25 x 25 m clamped at x = 0, the paper's, in (n, m, m) cells."""

    def beam(material: fem.Material, n: int = 8, m: int = 2, **options) -> fem.Problem:
        cell, degree = options.pop("cell", "hexahedron"), options.pop("degree", 1)
        mesh = fem.box([LENGTH, 25.0, 25.0], [n + 1, m + 1, m + 1], cell)
        return fem.Problem.build(
            mesh, material, fixed=fem.Plane(0, "min"), degree=degree, **options
        )

    return beam


@pytest.fixture(scope="session")
def pull() -> Callable[..., Tensor]:
    """Nodal forces (1, N, 3) of the dead traction (0, 0, -q) [Pa] on the end x = max."""

    def pull(problem: fem.Problem, q: float) -> Tensor:
        def stress(x):
            return np.multiply.outer([0.0, 0.0, -q / YOUNG], np.ones(x.shape[1:]))

        return traction(problem, fem.Plane(0, "max"), stress)[None]

    return pull


@pytest.fixture(scope="session")
def corner() -> Callable[[fem.Problem, Tensor], Tensor]:
    """Displacement (3,) [-] of the corner (max, max, max) of a box."""

    def corner(problem: fem.Problem, displacement: Tensor) -> Tensor:
        return displacement[0, int(problem.points.sum(dim=1).argmax())]

    return corner


@pytest.fixture(scope="session")
def newton(beam) -> fem.Newton:
    """The reference solver of a small beam."""
    return fem.Newton(beam(fem.NeoHookeanLn(0.3)), linear="superlu", tol=1e-10)


@pytest.fixture(scope="session")
def snapshots(newton) -> Tensor:
    """Its solutions for sixty random loads of three modes, deflections of up to 0.4 L."""
    family = fem.ModalLoads(newton.linear_solver, n_modes=3)
    return fem.solve(newton, family.sample(0, range(60))).displacement


@pytest.fixture
def counted(monkeypatch) -> list[int]:
    """A list that grows by one with each factorisation."""
    calls, factorise = [], SuperLU.factorise

    def count(self, values):
        calls.append(len(values))
        return factorise(self, values)

    monkeypatch.setattr(SuperLU, "factorise", count)
    return calls

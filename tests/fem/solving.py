"""Loads, solutions and bodies without compiled loops that the tests of the mechanics share."""

import skfem
import torch
from torch import Tensor
from torch.testing import assert_close

from dpl import fem
from dpl.fem.linear import SuperLU, full_matrix

YOUNG, LENGTH = 4500.0, 100.0  # of the paper's beam [Pa], [m]
KINDS = [(cell, d) for cell in ("triangle", "quad", "tetra", "hexahedron") for d in (1, 2)]


class Uncompiled(fem.Problem):
    """A problem without compiled loops."""

    _compiled = None


def uncompiled(problem: fem.Problem) -> Uncompiled:
    """Return the same body without compiled loops."""
    return Uncompiled(**problem.__getstate__())


def noise(*shape: int, seed: int = 0) -> Tensor:
    """Return random numbers."""
    random = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=random, dtype=torch.float64)


def bar(cell: str, count: int) -> skfem.Mesh:
    """Return a bar 4 m long, its sides 1 m, with `count` grid cells along x and one across."""
    build, across = (fem.box, 2) if cell in ("tetra", "hexahedron") else (fem.rectangle, 1)
    return build([4.0, *[1.0] * across], [count + 1, *[2] * across], cell)


def sliding(axes: int) -> list[fem.DirichletBC]:
    """Return supports that let the sides where a coordinate is smallest slide in their planes."""
    values = torch.eye(axes).tolist()
    return [
        fem.DirichletBC(fem.Plane(axis, "min"), [0.0 if one else None for one in values[axis]])
        for axis in range(axes)
    ]


def rest(problem: fem.Problem) -> Tensor:
    """Return the displacement zero, (1, N, D)."""
    return torch.zeros(1, *problem.shape, dtype=torch.float64)


def load_of(force: Tensor) -> fem.Load:
    """Return nodal forces (B, N, D) [-] as loads of the paper's beam."""
    return fem.Load(force, torch.full((len(force),), YOUNG, dtype=torch.float64))


def without_load(problem: fem.Problem, guess: Tensor | None = None, **options) -> fem.Solution:
    """Return the last solution of Newton's method under the supports and follower loads alone."""
    *_, last = fem.Newton(problem, **options).iterate(load_of(rest(problem)), guess=guess)
    return last


def inertia(problem: fem.Problem, displacement: Tensor) -> int:
    """Return the number of negative eigenvalues of K at a displacement (1, N, D)."""
    tangent = problem.linearise(displacement).tangent[0].numpy()
    return SuperLU(problem.pattern).factorise(tangent).negative_pivots


def poisson(ratio: float) -> float:
    """Return Poisson's ratio where the bulk modulus is so many shear moduli."""
    return (3 * ratio - 2) / (6 * ratio + 2)


def assert_derivatives(problem: fem.Problem, u: Tensor, v: Tensor, rtol: float = 1e-11) -> None:
    """Assert that the force is the slope of the energy, and the tangent that of the force.

    Args:
        problem: A body with a potential.
        u: Displacements that invert nothing, (B, N, D).
        v: Changes of them, (B, N, D).
        rtol: Relative difference of force and slope.
    """
    u, v = u.clone().requires_grad_(), torch.where(problem.free, v, 0.0)
    (slope,) = torch.autograd.grad(problem.energy(u).sum(), u)
    u = u.detach()
    assert_close(problem.internal_force(u), slope, rtol=rtol, atol=1e-13)
    product = torch.where(problem.free, problem.tangent_product(u, v), 0.0)
    ahead, behind = (problem.internal_force(u + step * v) for step in (1e-6, -1e-6))
    change = torch.where(problem.free, (ahead - behind) / 2e-6, 0.0)
    assert (change - product).abs().max() < 1e-7 * product.abs().max()
    for values, direction, expected in zip(problem.tangent(u), v, product, strict=True):
        K = torch.from_numpy(full_matrix(problem.pattern, values.numpy()).toarray())
        found = K @ direction[problem.free]
        assert_close(found, expected[problem.free], rtol=1e-10, atol=1e-13)

"""Displacement that follows from the rotations and the strains of the linear solution."""

import torch
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem.materials.rows import in_rows, product, transposed
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.solution import Load

SERIES_ANGLE = 0.3  # rotation angle below which sin(t)/t - 1 is its series [rad]


def rotated_strain(H: Tensor) -> Tensor:
    """Return exp(W) (I + e) - I - H of H = e + W, e symmetric and W skew, in rows (..., 9, c).

    The displacement gradient of the strain e in the frame rotated by W, minus that of the linear
    theory: of second order in H.

    Source: Huang, Tong, Zhou, Bao, Desbrun (2011), Interactive shape interpolation through
    controllable dynamic deformation, IEEE TVCG 17 (rotation-strain coordinates).
    """
    other = transposed(H)
    W, e = (H - other) / 2, (H + other) / 2
    square = W.square().sum(dim=-2, keepdim=True) / 2  # of the angle
    small = square < SERIES_ANGLE**2
    angle = torch.where(small, 1.0, square).sqrt()
    series = -square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72)))
    first = torch.where(small, series, angle.sin() / angle - 1)  # sin(t)/t - 1
    cosine = 0.5 - square / 24 * (1 - square / 30 * (1 - square / 56 * (1 - square / 90)))
    second = torch.where(small, cosine, (1 - angle.cos()) / angle**2)
    beyond = first * W + second * product(W, W)  # exp(W) - I - W
    return beyond + product(W + beyond, e)


def warped_solution(solver: LinearSolver, load: Load) -> Tensor:
    """Return the linear solution with finite rotations under one load, (1, N, D) [-].

    The mean gradient H of the linear solution in a cell becomes exp(W) (I + e), see
    `rotated_strain`. The displacement is the one whose gradients are nearest to these in the energy
    of the linear body. Bent bodies keep their length, so that it is a start for iterations where
    the linear solution is none.

    Source: see `rotated_strain`.

    Args:
        solver: Linear solver of the body, with the parameters of the load.
        load: The load, B = 1.
    """
    problem, factor = solver.problem, solver.float32_factor
    right = problem.restrict(load.force[0] - problem.support_force)
    linear = problem.prescribed + problem.extend(factor.apply(right))
    volumes, cells, dim = problem.dV.sum(dim=1), problem.cells, problem.shape[1]
    mean = (problem.dN * problem.dV[..., None, None]).sum(dim=1)  # times the volume, (E or 1, A, D)
    H = linear[cells].mT @ (mean / volumes[:, None, None])
    change = rotated_strain(in_rows(pad(H, (0, 3 - dim, 0, 3 - dim)))).mT.unflatten(-1, (3, 3))
    stress = problem.material.centred().rest_stress(change[None, :, None])[0, :, 0, :dim, :dim]
    parts = (mean @ stress.mT).flatten(0, 1)  # nodal forces of the cells
    force = torch.zeros_like(linear).index_add_(0, cells.flatten(), parts)
    return (linear + problem.extend(factor.apply(problem.restrict(force))))[None]

"""Bodies and solves that several cases share."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem import Load, Material, Newton, Plane, Problem, Solution, Status, box, rectangle

Array = NDArray[np.float64]


def balanced(newton: Newton, force: Tensor | None = None, guess: Tensor | None = None) -> Solution:
    """Return the solution under nodal forces (N, D) [-]; without forces, under moved supports."""
    force = torch.zeros(newton.problem.shape, dtype=torch.float64) if force is None else force
    load = Load(force[None], torch.ones(1, dtype=torch.float64))
    *_, last = newton.iterate(load, guess=guess)
    if not last.converged:
        raise ArithmeticError(f"{Status(int(last.status))}, residual {float(last.residual):.1e}")
    return last


NAMES = {
    ("hexahedron", 1): "hex8",
    ("hexahedron", 2): "hex27",
    ("tetra", 1): "tet4",
    ("tetra", 2): "tet10",
}


def paper_beam(
    law: Material, cells: Sequence[int], cell: str = "hexahedron", degree: int = 1
) -> Problem:
    """Return the paper's beam, 100 x 25 (x 25) m, fixed at x = 0."""
    build = box if len(cells) == 3 else rectangle
    mesh = build([100.0, 25.0, 25.0][: len(cells)], [n + 1 for n in cells], cell)
    return Problem.build(mesh, law, fixed=Plane(0, "min"), degree=degree)


def slender(
    law: Material, cells: Sequence[int], cell: str = "hexahedron", degree: int = 2
) -> Problem:
    """Return a clamped beam of cross-section 1 x 1 with cubic cells."""
    mesh = box([cells[0] / cells[1], 1.0, 1.0], [n + 1 for n in cells], cell)
    return Problem.build(mesh, law, fixed=Plane(0, "min"), degree=degree)


def lattice(points: Array) -> NDArray[np.int_]:
    """Return the node numbers of a grid by their positions along the axes, (n1, ..., nD)."""
    ranks = [np.unique(x.round(9), return_inverse=True)[1] for x in points.T]
    nodes = np.empty([rank.max() + 1 for rank in ranks], dtype=np.int64)
    nodes[tuple(ranks)] = np.arange(len(points))
    return nodes


def mean(field: Tensor, weights: Tensor) -> float:
    """Return the mean of nodal values (N,) over the face whose consistent weights are given."""
    return float((field * weights).sum() / weights.sum())

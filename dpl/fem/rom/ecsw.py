"""Hyper-reduction by energy-conserving sampling and weighting (ECSW): few weighted cells."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular
from torch import Tensor

from dpl.fem.assembly.follower_loads import NO_LOADS
from dpl.fem.linear.interface import SymmetricProduct, full_matrix
from dpl.fem.problem import Problem

Array = NDArray[np.float64]
BLOCK = 16  # states whose cell forces are in memory at a time


class Cubature(NamedTuple):
    """Weighted cells whose reduced forces approximate those of all cells."""

    cells: Tensor  # numbers of the cells, ascending, (C,)
    weights: Tensor  # positive weights, (C,)
    error: float  # relative error of the reduced forces at the states they were fitted to [-]


def cubature(
    problem: Problem,
    vectors: Tensor,
    states: Tensor,
    tolerance: float,
    candidates: Tensor | None = None,
) -> Cubature:
    """Return weighted cells that reproduce the reduced forces of all cells at some states.

    The nonlinear part sum_e w_e V_e^T (f_e(u) - K_e(0) u_e) is fitted, each state relative to its
    whole reduced force, in the norm in which K(0) is the identity. (Fitting whole forces in the
    Euclidean norm takes about twice the cells for the same accuracy on the paper's beam.)

    Source: Farhat, Avery, Chapman, Cortial (2014), Int. J. Numer. Methods Eng. 98, section 3.

    Args:
        problem, vectors: The body and V, (N, D, R).
        states: Displacements, (S, N, D); the memory is C^2 numbers for any S.
        tolerance: Root of the mean square of the relative errors [-], not below 1e-6.
        candidates: Numbers of the cells to choose from, (C,); None: all.
    """
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance = {tolerance} must lie between 0 and 1")
    numbers = torch.arange(len(problem.cells)) if candidates is None else candidates
    count, white = len(numbers), vectors @ whitening(problem, vectors)
    cells = ReducedMesh(problem, white, numbers, torch.ones(count, dtype=torch.float64))
    rows = cells.basis.view(count, -1, vectors.shape[2])
    gram, target = torch.zeros(count, count).double(), torch.zeros(count).double()
    body, basis = replace(problem, springs=None, follower_loads=NO_LOADS), white.flatten(0, 1)
    if problem.moved_supports:  # they cause forces too
        body = replace(body, free=problem.free | (problem.prescribed != 0))
    of_cells, of_body = _linear_force(cells.problem), _linear_force(body)
    size, used = 0.0, 0
    for part in states.split(BLOCK):
        columns, totals = [], []
        for u in part:
            at_cells = u[cells.nodes]
            force = cells.problem.evaluate(at_cells[None]).internal[0]
            whole = body.evaluate(u[None]).internal[0]
            scale = (whole.flatten() @ basis).norm()
            beyond = (force - of_cells(at_cells)).view(count, 1, -1)
            if scale > 0:
                columns.append((beyond @ rows)[:, 0].T / scale)
                totals.append((whole - of_body(u)).flatten() @ basis / scale)
        used += len(columns)
        if columns:
            together, total = torch.cat(columns), torch.cat(totals)
            gram.addmm_(together.T, together)
            target += together.T @ total
            size += float(total @ total)
    found = nonnegative(gram.numpy(), target.numpy(), size, tolerance, max(used, 1) ** 0.5)
    return found._replace(cells=numbers[found.cells])


def _linear_force(body: Problem) -> Callable[[Tensor], Tensor]:
    """Return the function u -> K(0) u, (N, D) each, at free degrees of freedom."""
    product = SymmetricProduct(body.pattern, body.stiffness_at_rest().numpy())
    return lambda u: body.extend(product(body.restrict(u)))


def nonnegative(
    gram: Array, target: Array, size: float, tolerance: float, scale: float
) -> Cubature:
    """Return sparse weights w > 0 with ||G w - b|| <= tolerance * scale, from G^T G and G^T b.

    Active-set method that stops when the tolerance is met: the column most aligned with the
    residual enters, columns whose weights would be negative leave.

    Source: Lawson, Hanson (1974), Solving Least Squares Problems, chapter 23; early stop as in
    Farhat, Avery, Chapman, Cortial (2014), Int. J. Numer. Methods Eng. 98, algorithm 1.

    Args:
        gram, target, size: G^T G, (E, E), G^T b, (E,), and b^T b.
        tolerance: Relative error [-], not below 1e-6, which G^T G cannot resolve.
        scale: Norm that the error is relative to, above 0.
    """
    count = len(gram)
    length_of = np.sqrt(gram.diagonal())
    length_of[length_of == 0] = np.inf
    rows, factor = np.empty((count, count)), np.empty((count, count))  # memory used when written
    kept, weights, barred = np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(count, dtype=bool)
    gradient = target
    error = float(np.sqrt(max(size, 0.0))) / scale
    while error > tolerance:
        gain = np.where(barred, 0.0, gradient / length_of)
        gain[kept] = 0.0
        new = int(gain.argmax())
        if gain[new] <= 0:
            break
        rows[len(kept)] = gram[new]
        kept, weights, first = np.append(kept, new), np.append(weights, 0.0), len(kept)
        while _factorised(factor, gram, kept, first):
            lower = factor[: len(kept), : len(kept)]
            best = cho_solve((lower, True), target[kept], check_finite=False)
            if (falling := best <= 0).any():
                length = (weights[falling] / (weights[falling] - best[falling])).min()
                weights += length * (best - weights)
                stay = ~falling | (weights > 1e-12 * weights.max())
                rows[: stay.sum()] = rows[: len(kept)][stay]
                kept, weights, first = kept[stay], weights[stay], int(stay.argmin())
            else:
                weights = best
                break
        else:  # linearly dependent on the others
            kept, weights = kept[:-1], weights[:-1]
        if new in kept:
            barred[:] = False
        else:  # entered because of rounding
            barred[new] = True
        gradient = target - weights @ rows[: len(kept)]
        square = size - weights @ (target + gradient)[kept]
        error = float(np.sqrt(max(square, 0.0))) / scale
    if not len(kept):
        kept, weights = np.zeros(1, dtype=np.int64), np.ones(1)
    order = kept.argsort()
    return Cubature(torch.from_numpy(kept[order]), torch.from_numpy(weights[order]), error)


def _factorised(factor: Array, gram: Array, kept: NDArray[np.int64], first: int) -> bool:
    """Set rows from `first` of the Cholesky factor of gram[kept, kept]; False if singular."""
    old, new = kept[:first], kept[first:]
    block = gram[np.ix_(new, new)]
    if first:
        right = gram[np.ix_(old, new)]
        left = solve_triangular(factor[:first, :first], right, lower=True, check_finite=False).T
        factor[first : len(kept), :first] = left
        block -= left @ left.T
    if (block.diagonal() <= 1e-12 * gram[new, new]).any():
        return False
    factor[first : len(kept), first : len(kept)] = np.linalg.cholesky(block)
    return True


class ReducedMesh:
    """Weighted cells of a body, without common nodes, with a basis at their nodes.

    Attributes:
        nodes: Nodes of the body at the nodes of the cells, (C A,).
        problem: The cells, their volumes multiplied by their weights.
        basis: V at their nodes, (C A D, R).
    """

    def __init__(self, problem: Problem, vectors: Tensor, cells: Tensor, weights: Tensor) -> None:
        """Select cells by numbers (C,), with weights (C,), of a body with basis V (N, D, R)."""
        nodes = problem.cells[cells].flatten()
        fields = len(nodes), problem.shape[1]

        def of_cells(tensor: Tensor) -> Tensor:
            return tensor.expand(len(problem.cells), *tensor.shape[1:])[cells].contiguous()

        functions = problem.volume_functions
        if functions is not None:  # orthonormal with the weighted volumes
            functions = of_cells(functions) / weights[:, None, None].sqrt()
        self.nodes = nodes
        self.problem = replace(
            problem,
            material=problem.material.of_cells(cells),
            points=problem.points[nodes],
            cells=torch.arange(len(nodes)).view(len(cells), -1),
            dN=of_cells(problem.dN),
            dV=of_cells(problem.dV) * weights[:, None],
            volume_functions=functions,
            free=torch.ones(fields, dtype=torch.bool),
            prescribed=torch.zeros(fields, dtype=torch.float64),
            boundary=torch.zeros(len(nodes), dtype=torch.bool),
            springs=None,
            follower_loads=NO_LOADS,
            links=NO_LOADS.links,
        )
        self.basis = vectors[nodes].flatten(0, 1).contiguous()


def whitening(problem: Problem, vectors: Tensor) -> Tensor:
    """Return L^-T, (R, R), with L L^T = V^T K(0) V; raise a ValueError if there is none."""
    stiffness = full_matrix(problem.pattern, problem.stiffness_at_rest().numpy())
    basis = vectors[problem.free].numpy()
    reduced = torch.from_numpy(basis.T @ (stiffness @ basis))
    lower, failed = torch.linalg.cholesky_ex((reduced + reduced.T) / 2)
    if failed:
        raise ValueError("V^T K(0) V must be positive definite; fix the rigid body modes")
    return torch.linalg.solve_triangular(lower, torch.eye(len(lower)).double(), upper=False).T

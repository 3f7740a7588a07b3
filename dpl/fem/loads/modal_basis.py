"""Eigenmodes of K(0), whole eigenspaces in one fixed basis."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh
from torch import Tensor

from dpl.fem.linear.interface import SingularMatrix, full_matrix
from dpl.fem.problem import Problem
from dpl.fem.solvers.linear import LinearSolver

Array = NDArray[np.float64]
SAME = 1e-6  # eigenvalues closer than this, relatively, are one eigenspace
CLUSTER = 0.05  # eigenvalues closer than this belong to one family and are excited together


class Modes(NamedTuple):
    """Lowest eigenpairs of K(0) on the free degrees of freedom.

    Attributes:
        values: Eigenvalues, ascending, (M,) [-].
        vectors: Orthonormal eigenvectors, zero where held, (N, D, M) [-].
    """

    values: Tensor
    vectors: Tensor


def eigenmodes(linear: LinearSolver, count: int) -> Modes:
    """Return the lowest modes, those of the last family all: `count` or a few more.

    Shift-invert Lanczos around zero with the stored factor of K(0). The same problem gives the
    same vectors: within an eigenspace the basis is the one that leans on the fields 1, x, y, z,
    x^2, ... in turn, with positive sign.

    Args:
        linear: The body, held, with the factor of its K(0).
        count: How many modes at least.

    Raises:
        ValueError: `count` is not between 1 and a third of the degrees of freedom, or the body is
            free to move.
        SingularMatrix: The moduli are so far apart that rounding leaves no mode.
    """
    linear = linear.reference
    problem = linear.problem
    size = problem.pattern.size
    if not 1 <= count <= size // 3:
        raise ValueError(f"n_modes = {count} must lie between 1 and {size // 3}")
    if loose := problem.unconstrained_rigid_body_modes():
        raise ValueError(f"{len(loose)} rigid modes are unconstrained: {', '.join(loose)}")
    stiffness = full_matrix(problem.pattern, problem.stiffness_at_rest().numpy())
    inverse = LinearOperator((size, size), matvec=linear.factor.solve, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(size)
    requested = min(count + 8, size - 2)
    try:
        values, vectors = eigsh(stiffness, requested, sigma=0.0, OPinv=inverse, v0=start, tol=1e-12)
    except ArpackError as error:
        raise SingularMatrix("its modes cannot be found") from error
    order = np.argsort(values)
    values, vectors = values[order], vectors[:, order]
    while count < requested and values[count] - values[count - 1] < CLUSTER * values[count]:
        count += 1
    probes = _probes(problem)
    cuts = np.flatnonzero(np.diff(values) > SAME * values[1:]) + 1
    for low, high in pairwise([0, *cuts.tolist(), len(values)]):
        vectors[:, low:high] = _leaning(vectors[:, low:high], probes)
    fields = torch.stack([problem.extend(vector) for vector in vectors[:, :count].T], dim=-1)
    return Modes(torch.from_numpy(values[:count]), fields)


def _probes(problem: Problem) -> Array:
    """Return fields (n, P): monomials up to degree 2 in each component, then fixed noise."""
    x = problem.points - problem.points.mean(dim=0)
    x, dim = x / x.abs().max(), x.shape[1]
    monomials = [torch.ones(len(x), dtype=torch.float64), *x.T]
    monomials += [x[:, i] * x[:, j] for i in range(dim) for j in range(i, dim)]
    axes = torch.eye(dim, dtype=torch.float64)
    fields = [problem.restrict(m[:, None] * axis) for m in monomials for axis in axes]
    noise = np.random.default_rng(1).standard_normal((len(fields[0]), 4))
    return np.column_stack([*fields, noise])


def _leaning(basis: Array, probes: Array) -> Array:
    """Return the basis of span(basis), (n, m), whose k-th vector is the k-th new probe in it."""
    sizes = np.linalg.norm(probes, axis=0)  # 0 of x^2 where all x are 0
    shadows = basis.T @ (probes / np.where(sizes > 0, sizes, 1.0))  # (m, P)
    chosen = np.zeros((len(shadows), 0))
    for shadow in shadows.T:
        rest = shadow - chosen @ (chosen.T @ shadow)
        if np.linalg.norm(rest) > 1e-4:
            rest -= chosen @ (chosen.T @ rest)
            chosen = np.column_stack([chosen, rest / np.linalg.norm(rest)])
        if chosen.shape[1] == len(shadows):
            break
    return basis @ chosen

"""Buckling: unstable directions of an equilibrium and its post-buckling branches."""

from dataclasses import replace

import numpy as np
import torch
from scipy.sparse.linalg import LinearOperator, eigsh
from torch import Tensor

from dpl.fem.linear.interface import full_matrix
from dpl.fem.solvers.newton import Newton
from dpl.fem.solvers.solution import Load, Solution


def unstable_directions(newton: Newton, solution: Solution) -> Tensor:
    """Return the eigenvectors of the tangent with negative eigenvalues, (M, N, D).

    The largest nodal displacement of each is 1; the most negative comes first. The solution of one
    load, B = 1, has the status UNSTABLE; one with another status is a ValueError.
    """
    count = int(solution.negative_pivots[0])
    if count < 1:
        raise ValueError("the solution has no negative pivots: there is no unstable direction")
    problem = newton.problem
    values = problem.linearise(solution.displacement).tangent[0].numpy()
    factor = newton.linear_solver.tangent_backend.factorise(values)
    matrix, size = full_matrix(problem.pattern, values), problem.pattern.size
    inverse = LinearOperator(matrix.shape, matvec=factor.solve, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(size)
    some = min(2 * count + 4, size - 1)  # eigenvalues around zero include positive ones
    lowest, vectors = eigsh(matrix, some, sigma=0.0, OPinv=inverse, v0=start)
    negative = np.argsort(lowest)[: int((lowest < 0).sum())]
    fields = torch.stack([problem.extend(vectors[:, k]) for k in negative])
    return fields / fields.norm(dim=-1).amax(dim=1)[:, None, None]


def post_buckling_branches(
    newton: Newton, load: Load, solution: Solution, *, imperfection: float = 0.02
) -> list[Solution]:
    """Return the equilibria of the branches that leave the primary path in its first direction.

    A column beyond its critical load buckles to either side: two solutions, one for each sign. The
    load is applied in ten steps with a small force in the unstable direction, which bends the body
    before it buckles; Newton then continues without that force. Where several directions are
    equally soft, as for a square section, a branch may be unstable itself; its status shows it.

    Args:
        newton, load, solution: The solver, one load, B = 1, and its unstable solution.
        imperfection: Norm of the small force over that of the load [-].
    """
    newton = replace(newton, mixed_integration=True)  # plain Newton returns to the primary path
    direction = unstable_directions(newton, solution)[:1]
    push = imperfection * newton.problem.acting(load.force).norm() * direction / direction.norm()
    branches = []
    for sign in (1.0, -1.0):
        u = newton.problem.prescribed[None]
        for part in np.linspace(0.1, 1.0, 10):
            perturbed = load._replace(force=part * (load.force + sign * push))
            *_, last = newton.iterate(perturbed, guess=u)
            u = last.displacement
        *_, last = newton.iterate(load, guess=u)
        branches.append(last)
    return branches

"""Unstable equilibria: the directions in which they give way, and where these lead."""

from dataclasses import replace

import numpy as np
import torch
from scipy.sparse.linalg import LinearOperator, eigsh
from torch import Tensor

from dpl.fem.linear.backends import make_backend
from dpl.fem.linear.interface import full_matrix
from dpl.fem.solvers.newton import Newton
from dpl.fem.solvers.solution import Load, Solution


def unstable_directions(newton: Newton, solution: Solution) -> Tensor:
    """Return the eigenvectors of the tangent with negative eigenvalues, (M, N, D).

    The largest nodal displacement of each is 1; the most negative comes first.

    Args:
        newton: The solver.
        solution: Its answer to one load, B = 1, with a status of UNSTABLE.

    Raises:
        ValueError: The answer is not known to be unstable.
    """
    count = int(solution.negative_pivots[0])
    if count < 1:
        raise ValueError("the answer has no negative pivots: there is no unstable direction")
    problem = newton.problem
    values = problem.linearise(solution.displacement).tangent[0].numpy()
    factor = make_backend(problem.pattern, newton.linear).factorise(values)
    size = problem.pattern.size
    inverse = LinearOperator((size, size), matvec=factor.solve, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(size)
    lowest, vectors = eigsh(
        full_matrix(problem.pattern, values),
        min(2 * count + 4, size - 1),  # around zero lie positive ones too
        sigma=0.0,
        OPinv=inverse,
        v0=start,
    )
    negative = np.argsort(lowest)[: int((lowest < 0).sum())]
    fields = torch.stack([problem.extend(vectors[:, k]) for k in negative])
    return fields / fields.norm(dim=-1).amax(dim=1)[:, None, None]


def post_buckling_branches(
    newton: Newton, load: Load, solution: Solution, *, imperfection: float = 0.02
) -> list[Solution]:
    """Return the answers that an unstable one gives way to, pushed in its first direction.

    A column beyond its critical load bends to either side: two answers, one for each sign. The load
    is applied once more with a small force in that direction, which bends the body before it can
    buckle; from there Newton goes on without that force. Where directions are equally soft, as
    for a square section, an answer may give way to another one in turn: its status says so.

    Args:
        newton: The solver.
        load: One load, B = 1.
        solution: Its unstable answer.
        imperfection: Norm of the small force over that of the load [-].

    Raises:
        ValueError: The answer is not known to be unstable.
    """
    newton = replace(newton, mixed_integration=True)  # plain Newton falls back to what gave way
    direction = unstable_directions(newton, solution)[:1]
    push = imperfection * newton.problem.acting(load.force).norm() * direction / direction.norm()
    answers = []
    for sign in (1.0, -1.0):
        bent = newton.problem.prescribed[None]
        for part in np.linspace(0.1, 1.0, 10):
            pushed = load._replace(force=part * (load.force + sign * push))
            bent = _end(newton, pushed, bent).displacement
        answers.append(_end(newton, load, bent))
    return answers


def _end(newton: Newton, load: Load, guess: Tensor) -> Solution:
    """Return where Newton ends, from a guess."""
    *_, last = newton.iterate(load, guess=guess)
    return last

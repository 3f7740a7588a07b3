"""Choice of the modes and cells of Newton's method that follows a fitted reduced model."""

from dataclasses import replace

import torch
from torch import Tensor

from dpl.fem import Load, Problem, SubspaceNewton
from dpl.scene import Sample

RANKS = (60, 160)  # numbers of modes that are tried, and all modes
CANDIDATES = 300  # cells to choose from
STATES = 32  # equilibria at which cells are chosen
TOLERANCE = 3e-2  # of the reduced forces of these cells [-]
MAX_STEPS = 6  # steps whose remaining error counts as that outside the subspace
LOADS = 50  # held-out loads by which the number of modes is chosen
NEAR_BEST = 1.1  # ratio of errors up to which fewer modes are preferred


def choose_newton(
    problem: Problem, modes: Tensor, states: Tensor, held_out: Sample, guesses: Tensor
) -> SubspaceNewton:
    """Return Newton's method in the number of modes that suits held-out loads best.

    The fewest modes are taken whose mean error after one step is nearly the smallest. The largest
    error after `MAX_STEPS` steps counts as the error outside the subspace.

    Args:
        problem: The body.
        modes: V, orthonormal, the most important mode first, (N, D, R).
        states: Equilibria at which cells are chosen, (S, N, D).
        held_out: Samples by whose errors the number is chosen; `LOADS` of them are enough.
        guesses: Their predictions, (S, N, D).
    """
    random = torch.randperm(len(problem.cells), generator=torch.Generator().manual_seed(0))
    candidates = random[:CANDIDATES].sort().values
    some = states[:: max(1, len(states) // STATES)][:STATES]
    whole = modes.shape[2]
    ranks = [*(rank for rank in RANKS if rank < whole), whole]
    solvers = [
        SubspaceNewton.within(
            problem, modes[..., :rank], some, tolerance=TOLERANCE, candidates=candidates
        )
        for rank in ranks
    ]
    means = [float(_errors(held_out, _after(one, held_out, guesses, 1)).mean()) for one in solvers]
    best = min(means)
    number = next(k for k, mean in enumerate(means) if mean <= NEAR_BEST * best)
    chosen = solvers[number]
    outside = float(_relative(held_out, _after(chosen, held_out, guesses, MAX_STEPS)).max())
    return replace(chosen, outside_error=outside)


def _after(solver: SubspaceNewton, samples: Sample, guesses: Tensor, steps: int) -> Tensor:
    """Return displacements (S, N, D) after some steps, from guesses (S, N, D)."""
    pairs = zip(samples.load.unbatch(), guesses, strict=True)
    return torch.stack([_last(solver, load, guess, steps) for load, guess in pairs])


def _last(solver: SubspaceNewton, load: Load, guess: Tensor, steps: int) -> Tensor:
    *_, last = solver.states(load, guess=guess[None], max_iter=steps, error_tol=0.0)
    return last.displacement[0]


def _errors(samples: Sample, displacement: Tensor) -> Tensor:
    """Return mean absolute errors, (S,)."""
    return (displacement - samples.displacement).flatten(1).abs().mean(dim=1)


def _relative(samples: Sample, displacement: Tensor) -> Tensor:
    """Return relative errors, (S,); 0 where the displacement is zero."""
    size = samples.displacement.flatten(1).norm(dim=1)
    error = (displacement - samples.displacement).flatten(1).norm(dim=1)
    return torch.where(size > 0, error / size.clamp(min=1e-300), 0.0)

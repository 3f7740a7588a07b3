"""Choice of the modes and cells of Newton's method that follows a fitted reduced model."""

from dataclasses import replace

import torch
from torch import Tensor

from dpl.fem import LinearSolver, Load, Problem, SubspaceNewton, estimate_error
from dpl.scene import Sample

RANKS = (60, 160)  # numbers of modes that are tried, and all modes
CANDIDATES = 600  # cells to choose from
STATES = 32  # equilibria at which cells are chosen
TOLERANCE = 3e-2  # of the reduced forces of these cells [-]
MAX_STEPS = 6  # also of the simulator, whose remaining error this is
LOADS = 50  # held-out loads by whose errors the number of modes is chosen
SUFFICIENT = 2e-3  # largest relative error of these loads for which no more modes are tried [-]
ERROR = 1e-5  # estimated relative error at which the steps end [-]


def choose_newton(
    problem: Problem, modes: Tensor, states: Tensor, held_out: Sample, guesses: Tensor
) -> SubspaceNewton:
    """Return Newton's method in the number of modes that suits held-out loads best.

    The fewest modes are taken with which `MAX_STEPS` steps bring every load below `SUFFICIENT`;
    else those with the smallest largest error. It counts as the error outside the subspace.

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
    best: SubspaceNewton | None = None
    for rank in ranks:
        solver = SubspaceNewton.within(
            problem, modes[..., :rank], some, tolerance=TOLERANCE, candidates=candidates
        )
        worst = float(_relative(held_out, _after(solver, held_out, guesses)).max())
        if best is None or worst < best.outside_error:
            best = replace(solver, outside_error=worst)
        if worst < SUFFICIENT:
            break
    assert best is not None
    return best


def remaining_error(
    solver: SubspaceNewton, linear: LinearSolver, loads: Load, guesses: Tensor
) -> float:
    """Return the largest relative error that the steps leave [-], as a correction estimates it.

    The correction is that of K(0) in the rotated frames of the nodes. The error is infinite where
    an element is inverted.

    Args:
        solver: Newton's method in the modes.
        linear: Linear solver of the body.
        loads: The loads, (S, N, D).
        guesses: Their predictions, (S, N, D).
    """
    pairs = zip(loads.unbatch(), guesses, strict=True)
    return max(
        estimate_error(linear, load, _last(solver, load, guess)[None], products=0).error
        for load, guess in pairs
    )


def _after(solver: SubspaceNewton, samples: Sample, guesses: Tensor) -> Tensor:
    """Return displacements (S, N, D) after the steps, from guesses (S, N, D)."""
    pairs = zip(samples.load.unbatch(), guesses, strict=True)
    return torch.stack([_last(solver, load, guess) for load, guess in pairs])


def _last(solver: SubspaceNewton, load: Load, guess: Tensor) -> Tensor:
    states = solver.states(load, guess=guess[None], max_iter=MAX_STEPS, error_tol=ERROR)
    *_, last = states
    return last.displacement[0]


def _relative(samples: Sample, displacement: Tensor) -> Tensor:
    """Return relative errors, (S,); 0 where the displacement is zero."""
    size = samples.displacement.flatten(1).norm(dim=1)
    error = (displacement - samples.displacement).flatten(1).norm(dim=1)
    return torch.where(size > 0, error / size.clamp(min=1e-300), 0.0)

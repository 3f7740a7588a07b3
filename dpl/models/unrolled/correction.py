"""Newton's method that follows a fitted reduced model, and the errors of both on held-out loads."""

import torch
from torch import Tensor

from dpl.fem import Problem, SubspaceNewton
from dpl.scene import Sample

RANKS = (60, 160)  # numbers of modes that are tried, and all modes
CANDIDATES = 600  # cells to choose from
STATES = 64  # equilibria at which cells are chosen
TOLERANCES = (3e-2, 3e-3)  # of the reduced forces of these cells, coarse and fine [-]
WORTH = 0.8  # ratio of mean errors after one step below which the fine tolerance is worth its time
MAX_STEPS = 6  # also of the simulator
LOADS = 50  # held-out loads by whose errors the number of modes is chosen
SUFFICIENT = 2e-3  # largest relative error of these loads for which no more modes are tried [-]
ERROR = 1e-5  # estimated relative error at which the steps end [-]
RIDGE = 1.0  # of exponents, in squares of logarithms
DEVIATIONS = 2.5  # standard deviations of fitted errors by which estimates exceed them


def fit_errors(sizes: Tensor, errors: Tensor) -> tuple[Tensor, Tensor]:
    """Return the logarithm of a factor, (), and exponents, (K + 2,), of estimated errors.

    The estimated error is the factor times the product of the powers of the sizes: a regression of
    the logarithms of errors on those of sizes. Exponents are shrunk towards those of the root of
    the last correction over the linear coordinates. The factor is such that an error `DEVIATIONS`
    standard deviations above the regression is estimated exactly. The deviations are leave-one-out
    residuals.

    Source: Allen (1974), Technometrics 16 (leave-one-out residuals of a ridge regression).

    Args:
        sizes: Sizes of held-out predictions, (S, K + 2).
        errors: Their true relative errors, (S,) [-].
    """
    tiny = torch.finfo(torch.float64).tiny
    logs, target = sizes.clamp(min=tiny).log(), errors.clamp(min=tiny).log()
    prior = torch.zeros_like(logs[0])
    prior[0], prior[-1] = -0.5, 0.5
    X = logs - logs.mean(dim=0)
    rest = target - target.mean() - X @ prior
    inverse = torch.linalg.inv(X.T @ X + RIDGE * torch.eye(len(prior)).double())
    change = inverse @ (X.T @ rest)
    leverage = 1 / len(X) + ((X @ inverse) * X).sum(dim=1)
    left_out = (rest - X @ change) / (1 - leverage).clamp(min=1e-3)
    deviation, exponents = left_out.square().mean().sqrt(), prior + change
    shift = target.mean() - logs.mean(dim=0) @ exponents
    return shift + DEVIATIONS * deviation, exponents


def choose_newton(
    problem: Problem, modes: Tensor, states: Tensor, held_out: Sample, guesses: Tensor
) -> tuple[SubspaceNewton, Tensor]:
    """Return Newton's method in the number of modes that suits held-out loads best.

    The fewest modes are taken with which `MAX_STEPS` steps bring every load below `SUFFICIENT`;
    else those with the smallest largest error. More cells are chosen where one step then leaves a
    mean error below `WORTH` times the other, as on bodies under a pressure, whose forces hide
    those of soft modes. The relative errors (S,) of the held-out loads after `MAX_STEPS` steps are
    returned, too.

    Args:
        problem: The body.
        modes: V, orthonormal, the most important mode first, (N, D, R).
        states: Equilibria at which cells are chosen, (S, N, D).
        held_out, guesses: `LOADS` samples by whose errors the number is chosen, and predictions.
    """
    random = torch.randperm(len(problem.cells), generator=torch.Generator().manual_seed(0))
    candidates = random[:CANDIDATES].sort().values
    some = states[:: max(1, len(states) // STATES)][:STATES]

    def solver(rank: int, tolerance: float) -> SubspaceNewton:
        return SubspaceNewton.within(
            problem, modes[..., :rank], some, tolerance=tolerance, candidates=candidates
        )

    def errors(found: SubspaceNewton, steps: int) -> Tensor:
        return relative_errors(held_out, _corrected(found, held_out, guesses, steps))

    coarse, fine = TOLERANCES
    ranks = [*(rank for rank in RANKS if rank < modes.shape[2]), modes.shape[2]]
    best: tuple[SubspaceNewton, Tensor] | None = None
    for rank in ranks:
        found = solver(rank, coarse)
        left = errors(found, MAX_STEPS)
        if best is None or left.max() < best[1].max():
            best = found, left
        if left.max() < SUFFICIENT:
            break
    assert best is not None
    finer = solver(best[0].vectors.shape[2], fine)
    if errors(finer, 1).mean() < WORTH * errors(best[0], 1).mean():
        return finer, errors(finer, MAX_STEPS)
    return best


def _corrected(solver: SubspaceNewton, samples: Sample, guesses: Tensor, steps: int) -> Tensor:
    """Return displacements (S, N, D) after at most so many steps from guesses (S, N, D)."""
    found = []
    for load, guess in zip(samples.load.unbatch(), guesses.split(1), strict=True):
        *_, last = solver.states(load, guess=guess, max_iter=steps, error_tol=ERROR)
        found.append(last.displacement)
    return torch.cat(found)


def relative_errors(samples: Sample, displacement: Tensor) -> Tensor:
    """Return relative errors, (S,); 0 where the displacement is zero."""
    size = samples.displacement.flatten(1).norm(dim=1)
    error = (displacement - samples.displacement).flatten(1).norm(dim=1)
    return torch.where(size > 0, error / size.clamp(min=1e-300), 0.0)

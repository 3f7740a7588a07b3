"""Newton's method that follows a fitted reduced model, and the errors of both on held-out loads."""

from dataclasses import replace

import torch
from torch import Tensor

from dpl.fem import Problem, SubspaceNewton
from dpl.fem.rom.pod import orthonormal_fields
from dpl.models.unrolled.fit import sample_weights
from dpl.models.unrolled.regression import fit_gains
from dpl.scene import Sample
from dpl.system.threads import one_thread

RANKS = (60, 100, 160)  # numbers of modes that are tried, and all modes
CANDIDATES = 600  # cells to choose from
STATES = 64  # equilibria at which cells are chosen
TOLERANCES = (3e-2, 3e-3)  # of the reduced forces of these cells, coarse and fine [-]
WORTH = 0.8  # ratio of errors after one step below which more modes or cells are worth their time
MAX_STEPS = 6  # also of the simulator
LOADS = 50  # held-out loads whose errors after all steps are measured
SUFFICIENT = 2e-3  # largest relative error of these loads that needs no further modes [-]
ERROR = 1e-5  # estimated relative error at which the steps end [-]
RIDGE = 1.0  # of exponents, in squares of logarithms
DEVIATIONS = 2.5  # standard deviations of fitted errors by which estimates exceed them
SMALL = 0.1  # part of held-out samples whose sizes are too small for a fit of their errors
LARGER = 3.0  # ratio to what the held-out samples have up to which values are plausible


def error_buffers(
    problem: Problem, held_out: Sample, guesses: Tensor, sizes: Tensor, left: Tensor
) -> dict[str, Tensor]:
    """Return the buffers of `Unrolled` for the estimated errors, by name.

    Args:
        problem: The body.
        held_out, guesses: Held-out samples and their predictions, (S, N, D).
        sizes: Sizes of the corrections of these predictions, (S, K + 2).
        left: Relative errors of the first samples after all steps, (at most S,).
    """
    both = (sizes, relative_errors(held_out, guesses)), (sizes[: len(left)], left)
    factors, exponents = zip(*(fit_errors(*pair) for pair in both), strict=True)
    body = problem.with_parameters(held_out.parameters)
    residuals = body.relative_residual_of(body.evaluate(guesses).internal, held_out.force)
    return {
        "error_factors": torch.stack(factors),
        "error_exponents": torch.stack(exponents),
        "least_sizes": sizes.quantile(SMALL, dim=0).clamp(min=1e-300),
        "largest_residual": LARGER * residuals.max(),
    }


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
    problem: Problem, modes: tuple[Tensor, Tensor], samples: Sample, predicted: Tensor,
    held_out: Sample, guesses: Tensor,
) -> tuple[SubspaceNewton, Tensor]:  # fmt: skip
    """Return Newton's method in the number of modes that suits the loads best.

    More modes are taken, or more cells, where one step then leaves a mean error of held-out loads
    below `WORTH` times the other; more than 100 modes only where `MAX_STEPS` steps leave an error
    above `SUFFICIENT`. There modes that lower the largest error are taken. The relative errors (S,)
    of the held-out loads after `MAX_STEPS` steps are returned, too.

    Args:
        problem: The body.
        modes: V, the most important mode first, (n, R), and their parities, (R,).
        samples: Samples; their solutions are states at which cells are chosen.
        predicted: Predictions (S, N, D) of the first samples by maps that are fitted to the others.
        held_out, guesses: Held-out samples and their predictions, (S, N, D).
    """
    random = torch.randperm(len(problem.cells), generator=torch.Generator().manual_seed(0))
    candidates = random[:CANDIDATES].sort().values
    states = samples.displacement
    some = states[:: max(1, len(states) // STATES)][:STATES]
    few = Sample(*(column[:LOADS] for column in held_out))
    vectors, parity = orthonormal_fields(modes[0], problem.free), modes[1]

    def solver(rank: int, tolerance: float) -> SubspaceNewton:
        return SubspaceNewton.within(
            problem, vectors[..., :rank], some, tolerance=tolerance, candidates=candidates
        )

    def errors(found: SubspaceNewton) -> list[Tensor]:
        return [relative_errors(few, u) for u in _corrected(found, few, guesses[:LOADS])]

    coarse, fine = TOLERANCES
    ranks = [*(rank for rank in RANKS if rank < vectors.shape[2]), vectors.shape[2]]
    best = solver(ranks[0], coarse)
    error, most = errors(best)
    for rank in ranks[1:]:
        if rank > RANKS[1] and most.max() < SUFFICIENT:
            break
        found = solver(rank, coarse)
        own, left = errors(found)
        falls = most.max() >= SUFFICIENT and left.max() < most.max()
        if falls or own.mean() < WORTH * error.mean():
            best, error, most = found, own, left
    if best.vectors.shape[2] != RANKS[1]:  # with more cells a step takes as long as in 100 modes
        finer = solver(best.vectors.shape[2], fine)
        best = finer if errors(finer)[0].mean() < WORTH * error.mean() else best
    best = with_gains(best, parity[: best.vectors.shape[2]], samples, predicted)
    return best, errors(best)[1]


def with_gains(
    solver: SubspaceNewton, parity: Tensor, samples: Sample, guesses: Tensor
) -> SubspaceNewton:
    """Return a solver with gains for predictions (S, N, D) of the first samples.

    They map the first step to the errors in the modes that `MAX_STEPS` steps leave.
    """
    truth, basis = samples.displacement[: len(guesses)], solver.vectors.flatten(0, 1)
    first, last = _corrected(solver, samples, guesses)
    steps, rest = (first - guesses).flatten(1) @ basis, (truth - last).flatten(1) @ basis
    gains = fit_gains(steps, rest, sample_weights(truth.flatten(1)), parity)
    return replace(solver, gains=gains)


def _corrected(solver: SubspaceNewton, samples: Sample, guesses: Tensor) -> tuple[Tensor, Tensor]:
    """Return displacements (S, N, D) of the first samples after one and after `MAX_STEPS` steps."""
    found = []
    with one_thread():
        for load, guess in zip(samples.load.unbatch(), guesses.split(1), strict=False):
            states = list(solver.states(load, guess=guess, max_iter=MAX_STEPS, error_tol=ERROR))
            # the guess, too, may be the best state after one step
            one = min(states[:2], key=lambda state: state.error)
            found.append((one.displacement, states[-1].displacement))
    first, last = map(torch.cat, zip(*found, strict=True))
    return first, last


def relative_errors(samples: Sample, displacement: Tensor) -> Tensor:
    """Return relative errors, (S,); 0 where the displacement is zero."""
    size = samples.displacement.flatten(1).norm(dim=1)
    error = (displacement - samples.displacement).flatten(1).norm(dim=1)
    return torch.where(size > 0, error / size.clamp(min=1e-300), 0.0)

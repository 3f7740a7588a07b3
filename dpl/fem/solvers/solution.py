"""What every solver takes and gives: Load, Solution, and the one sentence they all say."""

import math
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from dpl.fem.problem import Evaluation, Problem

LEAST_TOL = 1e-15  # below it, rounding decides whether an answer is accepted [-]


class _Load(NamedTuple):
    force: Tensor
    young: Tensor
    poisson: Tensor


class Load(_Load):
    """Dead nodal forces on a batch of bodies.

    Attributes:
        force: Nodal forces over E L^2 (E L in 2D), (B, N, D) [-].
        young: Young's moduli E that these stand for, (B,) [Pa]; no answer depends on them.
        poisson: Poisson's ratios of the bodies, (B, P) [-]: P = 1 where each load has its own, else
            P = 0, which may be left out.
    """

    __slots__ = ()

    def __new__(cls, force: Tensor, young: Tensor, poisson: Tensor | None = None) -> "Load":
        """Take the columns; Poisson's ratios (B,) too."""
        return super().__new__(cls, force, young, as_column(young, poisson))

    def unbatch(self) -> "list[Load]":
        """Return each load alone, B = 1."""
        parts = (slice(k, k + 1) for k in range(len(self.force)))
        return [Load(*(column[part] for column in self)) for part in parts]


def as_column(young: Tensor, poisson: Tensor | None) -> Tensor:
    """Return Poisson's ratios (B,) or (B, P) as (B, P), P = 0 if left out, of moduli (B,)."""
    if poisson is None:
        return young.new_zeros(*young.shape, 0)
    return poisson[..., None] if poisson.dim() == young.dim() else poisson


class Status(IntEnum):
    """What is known of an answer."""

    CONVERGED = 0  # in balance, nothing inverted, and stable as far as it was examined
    UNSTABLE = 1  # in balance, but not a minimum of the energy: the tangent has negative pivots
    NO_VALID_EQUILIBRIUM = 2  # the path of equilibria from rest ends below the whole load
    NOT_CONVERGED = 3  # iterations ran out, or go on

    def __str__(self) -> str:
        """Return it in words."""
        return self.name.lower().replace("_", " ")


class Solution(NamedTuple):
    """Displacements under a load, with what is known of them.

    Attributes:
        displacement: Over L, (B, N, D) [-].
        residual: ||R_free|| / ||f|| at `displacement` under the whole load, (B,) [-], see
            `Problem.relative_residual_of`.
        volume_ratio: min det F at `displacement`, (B,) [-].
        status: `Status` as a number, (B,).
        negative_pivots: Negative eigenvalues of the tangent there, (B,); -1: not examined.
        iterations: Linear solves so far, with a tangent or with what stands for one, (B,).
        factorisations: Tangents factorised so far, (B,); that of the rest state is the scene's.
        load_factor: Part of the load for which an equilibrium is known, (B,) [-].
        seconds: Time so far, (B,) [s].
        from_guess: Whether it goes on from a guess that was given, (B,).
    """

    displacement: Tensor
    residual: Tensor
    volume_ratio: Tensor
    status: Tensor
    negative_pivots: Tensor
    iterations: Tensor
    factorisations: Tensor
    load_factor: Tensor
    seconds: Tensor
    from_guess: Tensor

    @property
    def converged(self) -> Tensor:
        """Whether it is in balance to the solver's tolerance and nothing is inverted, (B,)."""
        return self.status <= Status.UNSTABLE

    @property
    def stable(self) -> Tensor:
        """Whether it is in balance and not known to be unstable, (B,)."""
        return self.status == Status.CONVERGED


def check_force(problem: Problem, load: Load) -> None:
    """Check that a load can act on a body. Forces that are not finite can: nothing balances them.

    Raises:
        ValueError: The force is not (B, N, D) of the body with B of 1 or more, or not float64.
    """
    shape, wanted = tuple(load.force.shape), tuple(problem.shape)
    if len(shape) != 3 or shape[1:] != wanted or not shape[0]:
        raise ValueError(f"force: its shape {shape} must be {('B', *wanted)}, B of 1 or more")
    if load.force.dtype != torch.float64:
        raise ValueError(f"force: {load.force.dtype} must be torch.float64")


def check_tol(tol: float) -> None:
    """Check a tolerance of residual ratios.

    Raises:
        ValueError: It is not at least `LEAST_TOL` and below 1.
    """
    if not LEAST_TOL <= tol < 1:
        raise ValueError(f"tol = {tol} must be at least {LEAST_TOL:g} and below 1")


def check_steps(solver: Any, parts: Sequence[str]) -> None:
    """Check the numbers of a solver that steps: tol, `parts`, and factor_reuse_tol,
    max_iter, max_total_iter.

    Raises:
        ValueError: One is out of range.
    """
    check_tol(solver.tol)
    for name in parts:
        if not 0 < getattr(solver, name) < 1:
            raise ValueError(f"{name} = {getattr(solver, name)} must lie between 0 and 1")
    if not 0 <= solver.factor_reuse_tol < math.inf:
        raise ValueError(f"factor_reuse_tol = {solver.factor_reuse_tol} must be 0 or more")
    for name in ("max_iter", "max_total_iter"):
        if getattr(solver, name) < 1:
            raise ValueError(f"{name} = {getattr(solver, name)} must be 1 or more")


class Solver(Protocol):
    """Anything that answers which displacement balances a load."""

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield ever better answers; the last one is the answer."""
        ...


def solve(solver: Solver, load: Load) -> Solution:
    """Return the last solution that a solver yields."""
    *_, last = solver.iterate(load)
    return last


def concatenate(parts: Sequence[Solution]) -> Solution:
    """Return solutions as one batch."""
    return Solution(*(torch.cat(column) for column in zip(*parts, strict=True)))


def run_lockstep(members: Sequence[Iterator[Solution]]) -> Iterator[Solution]:
    """Yield the solutions of single loads as batches; a load that has ended repeats its end."""
    states = [next(member) for member in members]
    while True:
        yield concatenate(states)
        news = [next(member, None) for member in members]
        if all(new is None for new in news):
            return
        states = [old if new is None else new for old, new in zip(states, news, strict=True)]


def evaluate_solution(
    problem: Problem,
    displacement: Tensor,
    load: Load,
    tol: float,
    *,
    iterations: int = 0,
    seconds: float = 0.0,
    from_guess: bool = False,
    evaluation: Evaluation | None = None,
) -> Solution:
    """Return a displacement (B, N, D) as the solution it is: evaluated, nothing believed.

    Args:
        problem: The body.
        displacement: Over L [-].
        load: What acts.
        tol: Residual ratio below which it counts as converged [-], at least `LEAST_TOL`, below 1.
        iterations: Spent on it.
        seconds: Spent on it [s].
        from_guess: Whether it goes on from a guess.
        evaluation: The body at the displacement, if that is there already.

    Raises:
        ValueError: `tol` is out of range.
    """
    check_tol(tol)
    problem = problem.at(load.poisson)
    internal, volume = evaluation or problem.evaluate(displacement)
    ratio = problem.relative_residual_of(internal, load.force)
    balanced = (ratio < tol) & (volume > 0)
    count = torch.full_like(volume, iterations, dtype=torch.int64)
    return Solution(
        displacement=displacement,
        residual=ratio,
        volume_ratio=volume,
        status=torch.where(balanced, int(Status.CONVERGED), int(Status.NOT_CONVERGED)),
        negative_pivots=torch.full_like(count, -1),
        iterations=count,
        factorisations=torch.zeros_like(count),
        load_factor=balanced.to(volume.dtype),
        seconds=torch.full_like(volume, seconds),
        from_guess=torch.full_like(balanced, from_guess),
    )

"""Interface of all solvers: Load, Solution, Status and Solver."""

from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import NamedTuple, Protocol, Self

import torch
from torch import Tensor

from dpl.fem.problem import Evaluation, Problem

LEAST_TOL = 1e-15  # relative residual below which rounding decides on convergence [-]


class _Load(NamedTuple):
    force: Tensor
    young: Tensor
    parameters: Tensor


class Load(_Load):
    """Dead nodal forces on a batch of bodies.

    Attributes:
        force: Nodal forces over E L^2 (E L in 2D), (B, N, D) [-].
        young: Young's moduli E, (B,) [Pa]; dimensionless solutions do not depend on them.
        parameters: Values of `Problem.parameter_ranges`, (B, P); may be left out if there are none,
            P = 0.
    """

    __slots__ = ()

    def __new__(cls, force: Tensor, young: Tensor, parameters: Tensor | None = None) -> "Load":
        """Create a load; parameters may be (B,) or (B, P)."""
        return super().__new__(cls, force, young, as_column(young, parameters))

    def unbatch(self) -> "list[Load]":
        """Return the loads one by one, B = 1."""
        count = len(self.force)
        if count == len(self.young) == len(self.parameters) == 1:
            return [self]
        columns = self.force, self.young.expand(count), self.parameters.expand(count, -1)
        return [Load(*parts) for parts in zip(*(c.split(1) for c in columns), strict=True)]


def as_column(young: Tensor, parameters: Tensor | None) -> Tensor:
    """Return parameters (B,) or (B, P) as (B, P); P = 0 for None, with `young` (B,)."""
    if parameters is None:
        return young.new_zeros(*young.shape, 0)
    return parameters[..., None] if parameters.dim() == young.dim() else parameters


class Status(IntEnum):
    """Status of a solution."""

    CONVERGED = 0  # equilibrium without inverted elements, not known to be unstable
    UNSTABLE = 1  # equilibrium whose tangent has negative pivots: no minimum of the energy
    NO_VALID_EQUILIBRIUM = 2  # load steps below the smallest one fail before the whole load
    NOT_CONVERGED = 3  # more iterations follow, or their limit was reached

    def __str__(self) -> str:
        """Return the status in lower-case words."""
        return self.name.lower().replace("_", " ")


class Solution(NamedTuple):
    """Displacements under a load with residual, stability and cost.

    Attributes:
        displacement: Over L, (B, N, D) [-].
        internal: Internal force at `displacement`, (B, N, D) [-].
        residual: ||R_free|| / ||f|| at `displacement` under the whole load, (B,) [-], see
            `Problem.relative_residual_of`.
        volume_ratio: min det F at `displacement`, (B,) [-].
        status: `Status` as a number, (B,).
        negative_pivots: Number of negative eigenvalues of the tangent there, (B,); 1 if there are
            some, not counted; -1 if unknown.
        iterations: Iterations so far, one linear solve each, (B,).
        factorisations: Tangents factorised so far, without K(0), (B,).
        load_factor: Part of the load for which an equilibrium is known, (B,) [-].
        seconds: Time so far, (B,) [s].
        from_guess: Whether the iterates continue from the given guess, (B,).
    """

    displacement: Tensor
    internal: Tensor
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
    def evaluation(self) -> Evaluation:
        """Internal force and min det F."""
        return Evaluation(self.internal, self.volume_ratio)

    @property
    def converged(self) -> Tensor:
        """Whether the state is an equilibrium to the tolerance without inverted elements, (B,)."""
        return self.status <= Status.UNSTABLE

    def unstable(self) -> Self:
        """Return the solution as unstable where negative pivots were not counted."""
        is_unknown = self.negative_pivots < 0
        pivots = torch.where(is_unknown, 1, self.negative_pivots)
        status = torch.where(self.converged & is_unknown, int(Status.UNSTABLE), self.status)
        return self._replace(negative_pivots=pivots, status=status)

    @property
    def stable(self) -> Tensor:
        """Whether the state is an equilibrium and not known to be unstable, (B,)."""
        return self.status == Status.CONVERGED


def check_force(problem: Problem, load: Load) -> None:
    """Raise a ValueError unless a force is (B, N, D) in float64, B >= 1; it may be infinite."""
    shape, wanted = tuple(load.force.shape), tuple(problem.shape)
    if len(shape) != 3 or shape[1:] != wanted or not shape[0]:
        raise ValueError(f"force.shape = {shape} must be {('B', *wanted)}, B of 1 or more")
    if load.force.dtype != torch.float64:
        raise ValueError(f"force.dtype = {load.force.dtype} must be torch.float64")


def check_tol(tol: float) -> None:
    """Raise a ValueError unless a tolerance is at least `LEAST_TOL` and below 1."""
    if not LEAST_TOL <= tol < 1:
        raise ValueError(f"tol = {tol} must be at least {LEAST_TOL:g} and below 1")


class Solver(Protocol):
    """Solver of the equilibrium equations."""

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the iterates; the last one is the solution."""


def solve(solver: Solver, load: Load) -> Solution:
    """Return the last iterate of a solver."""
    *_, last = solver.iterate(load)
    return last


def concatenate(parts: Sequence[Solution]) -> Solution:
    """Return several solutions as one batch."""
    if len(parts) == 1:
        return parts[0]
    return Solution(*(torch.cat(column) for column in zip(*parts, strict=True)))


def run_lockstep(members: Sequence[Iterator[Solution]]) -> Iterator[Solution]:
    """Yield the iterates of single loads as batches; a load that has ended repeats its last one."""
    states = [next(member) for member in members]
    while True:
        yield concatenate(states)
        following = [next(member, None) for member in members]
        if all(state is None for state in following):
            return
        states = [new or old for old, new in zip(states, following, strict=True)]


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
    """Return a displacement (B, N, D) [-] as a solution, with its residual and min det F.

    It counts as converged below the relative residual `tol` [-]. `evaluation` has the internal
    force and min det F at the displacement, if known.
    """
    check_tol(tol)
    problem = problem.with_parameters(load.parameters)
    internal, volume = evaluation or problem.evaluate(displacement)
    ratio = problem.relative_residual_of(internal, load.force)
    balanced = (ratio < tol) & (volume > 0)
    count = torch.full_like(volume, iterations, dtype=torch.int64)
    return Solution(
        displacement=displacement,
        internal=internal,
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

"""Interface of the solver that computes the solutions of a scene."""

from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

from dpl.fem.problem import Problem
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.solution import Load, Solution


@runtime_checkable
class ReferenceSolver(Protocol):
    """Solver of a scene. Data sets and comparisons hold its solutions.

    Any class with these attributes can be the solver of a scene. The configuration calls it with
    the keyword `problem`. A load brings its own parameters where the law has ranges:
    `problem.with_parameters(load.parameters)` is its body.
    """

    @property
    def problem(self) -> Problem:
        """Body."""

    @property
    def tol(self) -> float:
        """Relative residual below which a solution counts as converged [-]."""

    @property
    def linear_solver(self) -> LinearSolver:
        """Linear solver with the factor of K(0) that the whole scene shares."""

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the solutions of the iterations; the last one is the result."""

    def identity(self) -> dict[str, Any]:
        """Return the options that determine the solutions, as plain data."""

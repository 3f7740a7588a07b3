"""Solvers of the equilibrium equations."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.solvers.anderson import AndersonSolver
    from dpl.fem.solvers.bifurcation import post_buckling_branches, unstable_directions
    from dpl.fem.solvers.differentiable import DifferentiableSolve
    from dpl.fem.solvers.error_estimate import ErrorEstimate, estimate_error
    from dpl.fem.solvers.linear import LinearSolver, ReferenceSolver
    from dpl.fem.solvers.newton import Newton
    from dpl.fem.solvers.solution import (
        Load,
        Solution,
        Solver,
        Status,
        check_force,
        check_tol,
        concatenate,
        evaluate_solution,
        run_lockstep,
        solve,
    )
else:
    __all__, __getattr__, __dir__ = public_names(__name__)

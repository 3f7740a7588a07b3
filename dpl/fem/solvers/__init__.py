"""Solvers of the equilibrium equations."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.solvers.anderson import Accelerated
    from dpl.fem.solvers.batched_newton import BatchedNewton
    from dpl.fem.solvers.bifurcation import branches, unstable_directions
    from dpl.fem.solvers.differentiable import Equilibrium
    from dpl.fem.solvers.linear import Linear
    from dpl.fem.solvers.newton import Newton
    from dpl.fem.solvers.solution import (
        Load,
        Solution,
        Solver,
        Status,
        check_force,
        check_tol,
        in_step,
        joined,
        judge,
        solve,
    )
else:
    __all__, __getattr__, __dir__ = public_names(__name__)

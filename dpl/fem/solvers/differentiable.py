"""Equilibrium as a differentiable function of load and parameters, by one adjoint solve each."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dpl.fem.linear.krylov import Map, solve_unsymmetric
from dpl.fem.solvers.newton import Newton
from dpl.fem.solvers.solution import Load, Status

ADJOINT_TOL = 1e-12  # relative residual of an adjoint solve with an unsymmetric tangent [-]


@dataclass(frozen=True, eq=False)
class DifferentiableSolve:
    """Displacement u(f, p) with f_int(u, p) = f, differentiable with respect to f and p.

    The forward pass is a Newton solve. In the backward pass a gradient g with respect to u becomes
    a = K(u)^-T g with respect to f, since K(u) du = df on free degrees of freedom, and
    -a . df_int/dp with respect to the parameters p of the body. The tangent at the
    solution is factorised at the first gradient. A follower load without potential makes it
    unsymmetric; the factor of the symmetric part then preconditions GMRES.

    The derivative is that of the branch of equilibria on which the solution lies, stable or not.
    There are no second derivatives.

    Source: the implicit function theorem; Giles, Pierce (2000), Flow Turbul. Combust. 65, section
    2.1, for the adjoint.

    Attributes:
        newton: The solver; its `tol` limits the accuracy of the gradients.
    """

    newton: Newton

    def __call__(self, load: Load, *, guess: Tensor | None = None) -> Tensor:
        """Return displacements over L, (B, N, D) [-], float64.

        Args:
            load: The load, on the CPU; differentiable in `force`, (B, N, D) [-], and `parameters`,
                (B, P).
            guess: Displacement to start from, (B, N, D) [-]; zero if left out.

        Raises:
            ValueError: A load of the batch has no solution.
            SingularMatrix: In the backward pass, at a critical load: the tangent is singular.
        """
        if load.force.device.type != "cpu":
            raise ValueError(f"load.force is on {load.force.device} and must be on the cpu")
        return _Equilibrium.apply(load.force.double(), load.parameters, guess, self.newton)


def _adjoint(newton: Newton, displacement: Tensor, parameters: Tensor) -> Map:
    """Return the function g -> K(u)^-T g, (n,) to (n,), at u (1, N, D) and parameters (1, P)."""
    system = newton.problem.with_parameters(parameters).linearise(displacement)
    values = system.tangent[0].numpy()
    factor = newton.linear_solver.tangent_backend.factorise(values)
    if system.skew is None:
        return factor.solve
    transposed = newton.problem.pattern, values, -system.skew[0].numpy()
    return partial(solve_unsymmetric, *transposed, factor.apply, rtol=ADJOINT_TOL)


class _Equilibrium(torch.autograd.Function):
    """See `DifferentiableSolve`."""

    @staticmethod
    def forward(
        ctx: Any, force: Tensor, parameters: Tensor, guess: Tensor | None, newton: Newton
    ) -> Tensor:
        parameters, young = parameters.detach(), torch.ones(len(force), dtype=torch.float64)
        load = Load(force.detach(), young, parameters)
        *_, answer = newton.iterate(load, guess=None if guess is None else guess.detach())
        if not answer.converged.all():
            lost = (~answer.converged).nonzero().flatten().tolist()
            states = ", ".join(f"load {k}: {Status(int(answer.status[k]))}" for k in lost)
            raise ValueError(f"no equilibrium to differentiate; of {len(force)} loads, {states}")
        ctx.newton, ctx.parameters, ctx.adjoints = newton, parameters, None
        ctx.save_for_backward(answer.displacement)
        return answer.displacement

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor | None, None, None]:
        problem, (displacement,) = ctx.newton.problem, ctx.saved_tensors
        if ctx.adjoints is None:  # kept: each row of a Jacobian needs them
            parameters = ctx.parameters.expand(len(displacement), -1)
            pairs = zip(displacement.split(1), parameters.split(1), strict=True)
            ctx.adjoints = [_adjoint(ctx.newton, *pair) for pair in pairs]
        pairs = zip(ctx.adjoints, map(problem.restrict, gradient), strict=True)
        adjoint_field = torch.stack([problem.extend(solve(right)) for solve, right in pairs])
        if not ctx.needs_input_grad[1]:
            return adjoint_field, None, None, None
        with torch.enable_grad():
            parameters = ctx.parameters.expand(len(displacement), -1).clone().requires_grad_()
            internal = problem.with_parameters(parameters).internal_force(displacement)
            work = (internal * adjoint_field).sum()
            (slope,) = torch.autograd.grad(work, parameters)
        return adjoint_field, -slope, None, None

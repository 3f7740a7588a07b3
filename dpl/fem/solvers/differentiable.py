"""The exact answer as a differentiable function of its load: one adjoint solve a gradient."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dpl.fem.linear.backends import make_backend
from dpl.fem.linear.interface import Backend, Factor
from dpl.fem.solvers.newton import Newton
from dpl.fem.solvers.solution import Load, Solution, Status


@dataclass(frozen=True, eq=False)
class DifferentiableSolve:
    """Displacement u(f) with f_int(u) = f, differentiable with respect to f.

    Forwards it is a Newton solve. Backwards, as K(u) du = df on free degrees of freedom, a gradient
    g with respect to u becomes K(u)^-1 g with respect to f: one solve with the symmetric tangent
    at the answer, factorised at the first gradient, whatever the number of iterations. What f
    itself is made of (newtons and Young's moduli by `Scene.load_of`, amplitudes of modes) is
    torch's business.

    The derivative is that of the branch of equilibria that the answer lies on, stable or not. Held
    degrees of freedom, moved ones included, do not depend on the load. Once differentiable.

    Source: the implicit function theorem; Giles, Pierce (2000), Flow Turbul. Combust. 65, section
    2.1, for the adjoint.

    Attributes:
        newton: Finds the answers; gradients are as exact as its `tol` lets the answers be.
    """

    newton: Newton

    def __call__(self, load: Load, *, guess: Tensor | None = None) -> Tensor:
        """Return displacements over L, (B, N, D) [-], float64.

        Args:
            load: What acts; differentiable in `force`, (B, N, D) [-].
            guess: Where Newton starts, (B, N, D) [-], such as the answer to a load nearby; zero if
                left out.

        Raises:
            ValueError: A load of the batch has no answer, and so no derivative; `solve`
                tells more about it. Or the load is not on the processor, or a derivative
                with respect to Poisson's ratios is asked for.
            SingularMatrix: When the gradient is asked for: a load is critical, the tangent at its
                answer has no inverse.
        """
        if load.force.device.type != "cpu":
            raise ValueError(f"the load is on {load.force.device}, Newton solves on the cpu")
        if load.poisson.requires_grad:
            raise ValueError("poisson: answers are differentiable in forces, not in it; detach it")
        return _Answer.apply(load.force.double(), load.poisson, guess, self)

    def solution(self, load: Load, *, guess: Tensor | None = None) -> Solution:
        """Return Newton's answers with what is known of them, without derivatives."""
        with torch.no_grad():
            *_, last = self.newton.iterate(load, guess=guess)
        return last

    def factors(self, displacement: Tensor, poisson: Tensor | None = None) -> list[Factor]:
        """Return the factors of the tangents at displacements (B, N, D) [-], one each.

        Args:
            displacement: Where.
            poisson: Of the loads, (B, P) [-].

        Raises:
            SingularMatrix: A tangent has none.
        """
        problem = self.newton.problem
        own = displacement.new_zeros(1, 0) if poisson is None else poisson
        pairs = zip(displacement, own.expand(len(displacement), -1), strict=True)
        tangents = [problem.at(nu[None]).linearise(u[None]).tangent[0] for u, nu in pairs]
        return [self._backend.factorise(tangent.numpy()) for tangent in tangents]

    @cached_property
    def _backend(self) -> Backend:
        problem = self.newton.problem
        return make_backend(problem.pattern, self.newton.linear, problem.near_null)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without what the backend has analysed."""
        return {"newton": self.newton}


class _Answer(torch.autograd.Function):
    """See `DifferentiableSolve`."""

    @staticmethod
    def forward(
        ctx: Any, force: Tensor, poisson: Tensor, guess: Tensor | None, parent: DifferentiableSolve
    ) -> Tensor:
        guess = None if guess is None else guess.detach()
        load = Load(force.detach(), torch.ones(len(force), dtype=torch.float64), poisson)
        answer = parent.solution(load, guess=guess)
        if not answer.converged.all():
            lost = (~answer.converged).nonzero().flatten().tolist()
            told = ", ".join(f"load {k}: {Status(int(answer.status[k]))}" for k in lost)
            raise ValueError(f"no equilibrium to differentiate; of {len(force)} loads, {told}")
        ctx.parent, ctx.poisson, ctx.factors = parent, poisson, None
        ctx.save_for_backward(answer.displacement)
        return answer.displacement

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        problem = ctx.parent.newton.problem
        if ctx.factors is None:  # kept: rows of a Jacobian ask again and again
            (displacement,) = ctx.saved_tensors
            ctx.factors = ctx.parent.factors(displacement, ctx.poisson)
        solved = [
            problem.extend(factor.solve(problem.restrict(one)))
            for factor, one in zip(ctx.factors, gradient, strict=True)
        ]
        return torch.stack(solved), None, None, None

"""Local loads: the part of the linear solution that the modes of a reduced model miss."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from dpl.fem.linear.interface import SymmetricProduct
from dpl.fem.linear.krylov import conjugate_gradients
from dpl.fem.symmetry import Symmetry
from dpl.models.invariant_basis import image_columns
from dpl.scene import Scene

MIN_PROBES = 16  # random fields that estimate the size of the missing part
RTOL = 1e-4  # relative residual of a linear solution whose parameters differ from the reference
MAX_ITER = 100


class LocalResponse(nn.Module):
    """K(0)^-1 f - V c of Galerkin linear solutions c, and an estimate of its size.

    A few global modes cannot represent the displacement near a load on a small area. The estimate
    takes the products of the missing part with random fields and all their images, without a
    solve, so that it is the same for a load and its images.

    Source: Halko, Martinsson, Tropp (2011), SIAM Rev. 53, section 4.3 (estimate of a norm from
    random products).

    Attributes:
        tol: Norm of the missing part over that of the linear solution above which a load is local.
        probes: Random fields, multiplied by K(0)^-1 - V (V^T K(0) V)^-1 V^T, (n, F).
    """

    probes: Tensor

    def __init__(self, scene: Scene, tol: float) -> None:
        """Take the scene with the factor of K(0), and the tolerance."""
        super().__init__()
        self._scene, self.tol = scene, tol
        self.register_buffer("probes", torch.zeros(int(scene.problem.free.sum()), 0))

    def fit(self, modes: Tensor, inverse: Tensor, group: list[Symmetry]) -> None:
        """Compute the probes.

        Args:
            modes: V, (n, R).
            inverse: (V^T K(0) V)^-1 of the reference body, (R, R).
            group: Symmetries of the body.
        """
        free, factor = self._scene.problem.free, self._scene.linear.reference.factor
        members = max(1, len(group))
        random = torch.Generator().manual_seed(0)
        count = -(-MIN_PROBES // members)
        fields = torch.randn(count, len(modes), generator=random, dtype=torch.float64)
        every = torch.cat([image_columns(fields, free, group, k) for k in range(members)])
        exact = torch.from_numpy(factor.solve_many(every.numpy()))
        self.probes = (exact.T - modes @ (inverse @ (modes.T @ every.T))).to(self.probes)

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Take the size of the checkpoint."""
        resize_buffers(self, state, prefix)
        super()._load_from_state_dict(state, prefix, *rest)

    def is_local(self, force: Tensor, size: Tensor) -> Tensor:
        """Return the mask of local loads, (B,).

        Args:
            force: Forces at free degrees of freedom, (B, n).
            size: Norms of the Galerkin linear solutions, (B,).
        """
        missing = (force.to(self.probes) @ self.probes).double().square().mean(dim=1)
        return missing > self.tol**2 * (size.square() + missing)

    def missing(self, force: Tensor, galerkin: Tensor, parameters: Tensor) -> Tensor:
        """Return K(0)^-1 f - V c, (B, n).

        Args:
            force: Forces at free degrees of freedom, (B, n).
            galerkin: V c, (B, n).
            parameters: Parameters of the law, (B, P).
        """
        solved: Tensor = _LinearSolve.apply(force, parameters, self)
        return solved - galerkin

    def solve(self, force: NDArray[np.float64], parameters: Tensor) -> NDArray[np.float64]:
        """Return K(0)^-1 f, (n,), of a load with parameters (P,)."""
        linear = self._scene.linear.reference
        preconditioner = linear.float32_factor
        if not len(parameters):
            return preconditioner.solve(force, RTOL)
        problem = self._scene.problem.with_parameters(parameters[None].cpu())
        rest = torch.zeros(1, *problem.shape, dtype=torch.float64)
        values = problem.linearise(rest).tangent[0].numpy()
        product = SymmetricProduct(problem.pattern, values)
        return conjugate_gradients(product, preconditioner.apply, force, RTOL, MAX_ITER)


def resize_buffers(module: nn.Module, state: dict[str, Any], prefix: str) -> None:
    """Give the buffers of a module the sizes that they have in a state dict."""
    for name, buffer in module.named_buffers(recurse=False):
        found = state.get(f"{prefix}{name}")
        if isinstance(found, Tensor) and found.ndim == buffer.ndim:
            setattr(module, name, buffer.new_empty(found.shape))


class _LinearSolve(torch.autograd.Function):
    """K(0)^-1 f; K(0) is symmetric, so the gradient is the same solve."""

    @staticmethod
    def forward(ctx: Any, force: Tensor, parameters: Tensor, response: LocalResponse) -> Tensor:
        """Return solutions (B, n) of forces (B, n)."""
        ctx.response, ctx.parameters = response, parameters
        rows = [
            response.solve(one.cpu().numpy(), own)
            for one, own in zip(force, parameters, strict=True)
        ]
        return torch.from_numpy(np.stack(rows)).to(force)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        """Return the gradient with respect to forces, (B, n)."""
        return _LinearSolve.apply(gradient, ctx.parameters, ctx.response), None, None

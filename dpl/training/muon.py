"""Muon for matrices and filters and Adam for all other parameters, as one optimiser."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

# Jordan et al. (2024): iterating this quintic polynomial moves all singular values close to 1
QUINTIC, ITERATIONS = (3.4445, -4.7750, 2.0315), 5
LONG = 2  # ratio of the sides of a matrix from which the iteration of its Gram matrix is cheaper


def orthogonal(matrix: Tensor) -> Tensor:
    """Return an approximation of the nearest matrix with orthonormal rows or columns.

    Singular values that were not tiny lie between 0.7 and 1.2, which is sufficient for optimiser
    steps. The dtype is that of the argument.

    The iterates of a matrix X are P X with polynomials P of X X^T. For a long matrix in float32
    only P is iterated, so that the whole matrix is multiplied twice and not in every iteration.

    Source: Jordan et al. (2024), Muon: an optimizer for hidden layers in neural networks.
    """
    a, b, c = QUINTIC
    tall = matrix.size(0) > matrix.size(1)
    x = matrix.T if tall else matrix
    x = x / x.norm().clamp(min=1e-7)
    is_long = x.dtype == torch.float32 and x.size(1) >= LONG * x.size(0)
    gram, eye = x @ x.T, torch.eye(len(x), dtype=x.dtype, device=x.device)
    iterate = eye if is_long else x  # P or P X
    for step in range(1, ITERATIONS + 1):
        factor = torch.addmm(gram, gram, gram, beta=b, alpha=c) + a * eye
        iterate = factor @ iterate
        if step < ITERATIONS:
            gram = factor @ gram @ factor if is_long else iterate @ iterate.T
    x = iterate @ x if is_long else iterate
    return x.T if tall else x


class Muon(torch.optim.AdamW):
    """Muon, orthogonalised momentum, for weight matrices; Adam for biases and slopes.

    The weights of a convolution (O, I, ...) count as the matrix (O, I ...) of its filters. Both
    parts have the same learning rate: the steps of Muon are scaled to the root mean square of
    Adam's steps. An accurate fit of a smooth function takes fewer steps than with Adam. Differs
    from `torch.optim.Muon` in the precision of matrix products: bfloat16 on GPUs only, since CPUs
    without bfloat16 emulate it far slower than float32; and in that it takes all parameters.

    Source: Jordan et al. (2024), Muon: an optimizer for hidden layers in neural networks; step size
    of Liu et al. (2025), Muon is scalable for LLM training, section 2.2.
    """

    def __init__(
        self,
        params: Iterable[nn.Parameter],
        *,
        lr: float = 1e-2,
        momentum: float = 0.95,
        betas: tuple[float, float] = (0.9, 0.99),
        weight_decay: float = 0.0,
    ) -> None:
        """Take all parameters.

        Args:
            params: All parameters.
            lr: Learning rate.
            momentum: Momentum of Muon.
            betas: Averaging coefficients of Adam.
            weight_decay: Decoupled weight decay of both.
        """
        if not 0 <= momentum < 1:
            raise ValueError(f"momentum = {momentum} must be 0 or more and less than 1")
        super().__init__(params, lr=lr, betas=betas, weight_decay=weight_decay)
        self.defaults["momentum"] = momentum
        for group in self.param_groups:
            group["momentum"] = momentum

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Update every parameter with a gradient; return the result of the closure."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        groups = self.param_groups
        for group in groups:
            lr, momentum = group["lr"], group["momentum"]
            for weights in group["params"]:
                if weights.ndim < 2 or weights.grad is None:
                    continue
                state = self.state[weights]
                if not state:
                    state["momentum_buffer"] = torch.zeros_like(weights)
                    state["step"] = torch.zeros(())  # Adam expects it in every restored state
                mean = state["momentum_buffer"].lerp_(weights.grad, 1 - momentum)
                update = weights.grad.lerp(mean, momentum).flatten(1)
                update = orthogonal(update.bfloat16() if update.is_cuda else update)
                weights.mul_(1 - lr * group["weight_decay"])
                size = -0.2 * lr * math.sqrt(max(update.shape))
                weights.add_(update.reshape(weights.shape), alpha=size)
        try:  # Adam updates the others
            self.param_groups = [
                {**group, "params": [p for p in group["params"] if p.ndim < 2]} for group in groups
            ]
            super().step()
        finally:
            self.param_groups = groups
        return loss

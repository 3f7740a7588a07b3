"""K(0)^-1 f for all parameters by conjugate gradients: compiled and as tensor operations."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd import Function

from dpl.fem.linear.condensation import Condensed, condensed_iteration
from dpl.fem.rom.stiffness_iteration import TermMatrices, conjugate_gradients
from dpl.fem.solvers.condensed_layers import CondensedLayers
from dpl.system.threads import on_threads


@dataclass(frozen=True, eq=False)
class IteratedInverse:
    """Solutions of forces by parity, see `StiffnessIteration`.

    Compiled loops solve on the CPU, one load and one parity after the other. Other devices and
    traced graphs do the same steps as tensor operations. K(0) is symmetric, so that the gradient
    with respect to a force is a solution with the same matrix; no step is stored for it.

    Attributes:
        blocks: Blocks of the node, (M, V).
        matrices: Terms of K(0).
        steps: Number of steps, see `count_steps`.
    """

    blocks: Condensed
    matrices: TermMatrices
    steps: int
    _on_device: "dict[torch.device, _Tensors]" = field(default_factory=dict, repr=False)

    def __call__(self, right: Tensor, factors: Tensor) -> Tensor:
        """Return the solutions, (B, M, m).

        Args:
            right: Forces by parity, (B, M, m), float64.
            factors: Factors of the terms, and 1, (B, T + 1), float64.
        """
        if torch.compiler.is_compiling() or torch.jit.is_tracing():
            return self.by_tensors(right, factors)
        found: Tensor = _Solve.apply(right, factors, self)
        return found

    def by_tensors(self, right: Tensor, factors: Tensor) -> Tensor:
        """Return the same by tensor operations."""
        layers, columns, entries = self._tensors(right.device)
        dtype = layers.layers[0].inverse.dtype
        matrix = torch.einsum("bk,kmjw->bmjw", factors, entries)

        def precondition(residual: Tensor) -> Tensor:
            return layers.solve(residual.to(dtype).transpose(0, 1)).transpose(0, 1).double()

        def product(x: Tensor) -> Tensor:
            return (matrix * x[..., columns]).sum(dim=-1)

        return conjugate_gradients(product, precondition, right, self.steps)

    def by_loops(self, right: Tensor, factors: Tensor) -> Tensor:
        """Return the same by compiled loops, on the threads of torch."""
        found = np.empty(right.shape)
        forces, rows = right.contiguous().numpy(), factors.numpy()
        structure = self.matrices.first_entry, self.matrices.columns

        def solve_one(b: int) -> None:
            every = self.matrices.at(rows[b])
            for values, entries, *pair in zip(
                self.blocks.values, every, forces[b], found[b], strict=True
            ):
                matrix = *structure, entries
                args = *self.blocks.fronts[:2], values, matrix, pair[0], self.steps, pair[1]
                condensed_iteration(*args)

        on_threads(solve_one, range(len(forces)))
        return torch.from_numpy(found)

    def products(self, x: Tensor) -> Tensor:
        """Return the product of each term with x (B, M, m), (B, T + 1, M, m)."""
        _, columns, entries = self._tensors(x.device)
        return torch.einsum("bmjw,kmjw->bkmj", x[..., columns], entries)

    def _tensors(self, device: torch.device) -> "_Tensors":
        if device not in self._on_device:
            layers = CondensedLayers.of(self.blocks, device)
            columns, entries = self.matrices.padded()
            self._on_device[device] = _Tensors(layers, columns.to(device), entries.to(device))
        return self._on_device[device]


class _Tensors(NamedTuple):
    """Blocks of the node and terms of K(0) on one device, see `TermMatrices.padded`."""

    layers: CondensedLayers
    columns: Tensor
    entries: Tensor


class _Solve(Function):
    """x = K(0)^-1 f with df = K(0)^-1 dx and da_k = -df K_k x."""

    @staticmethod
    def forward(ctx: Any, right: Tensor, factors: Tensor, inverse: IteratedInverse) -> Tensor:
        on_cpu = right.device.type == "cpu"
        x = (inverse.by_loops if on_cpu else inverse.by_tensors)(right, factors)
        ctx.save_for_backward(x, factors)
        ctx.inverse = inverse
        return x

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor | None, None]:
        x, factors = ctx.saved_tensors
        right: Tensor = _Solve.apply(gradients[0], factors, ctx.inverse)
        of_factors = None
        if ctx.needs_input_grad[1]:
            of_factors = -torch.einsum("bmj,bkmj->bk", right, ctx.inverse.products(x))
        return right, of_factors, None

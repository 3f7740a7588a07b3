"""Linear solutions of random loads, and their whitening for the input of a network."""

import torch
from torch import Tensor, nn

from dpl.fem.rom.pod import pod
from dpl.models.interface import full_precision
from dpl.scene import Scene

SCALE_STREAM = 3  # random stream of the loads for scales; samples use smaller numbers
SCALE_LOADS = 256
MODES = 128  # of a field that are whitened


def sampled_solutions(scene: Scene) -> tuple[Tensor, Tensor]:
    """Return the forces and linear solutions of random loads, (S, N, D) each [-], float64.

    The loads are the first of a random stream of their own. Parameters have their values at rest.
    """
    force = scene.loads.sample((0, SCALE_STREAM), range(SCALE_LOADS)).force
    return force, torch.stack([scene.linear.reference.solve(one) for one in force])


def partial_whitening(size: Tensor) -> Tensor:
    """Return divisors (n,) of coordinates with root mean squares `size` (n,).

    The divisor of a coordinate is size^0.6 times the largest size^0.4, so that small coordinates
    are amplified less than by whitening, and rounding errors at most by 1000.
    """
    largest = size.max().clamp(min=1e-30)
    return (size**0.6 * largest**0.4).clamp(min=1e-3 * float(largest))


class FieldWhitening(nn.Module):
    """Linear map of nodal fields that divides their POD coordinates by `partial_whitening`.

    A few bending modes dominate displacements. Gradient descent learns the influence of the other
    modes as much later as their coordinates are smaller; divided by their sizes all are learnt
    together. The part of a field outside the modes is divided like the last of them, so that the
    map is invertible.

    Source: LeCun, Bottou, Orr, Mueller (1998), Efficient BackProp, section 4.3 (decorrelated inputs
    of equal variance).
    """

    modes: Tensor
    factors: Tensor

    def __init__(self, fields: Tensor, free: Tensor) -> None:
        """Compute the modes of fields (S, N, D), which count at `free` (N, D) only."""
        super().__init__()
        columns = fields[:, free].double()
        vectors = pod(columns, min(MODES, *columns.shape)).vectors
        size = (columns @ vectors).square().mean(dim=0).sqrt()
        kept = size > 1e-6 * size.max()
        vectors, size = vectors[:, kept], size[kept]
        factors = 1 / partial_whitening(size)
        outside = (columns - columns @ vectors @ vectors.T) * factors[-1]
        square = (factors * size).square().sum() + outside.square().sum(dim=1).mean()
        factors = factors / (square / len(vectors)).sqrt()  # the mean square of a result is one
        modes = vectors.new_zeros(len(factors), free.numel())
        modes[:, free.flatten()] = vectors.T
        self.register_buffer("modes", modes.float(), persistent=False)
        self.register_buffer("factors", factors.float(), persistent=False)

    def forward(self, field: Tensor) -> Tensor:
        """Return whitened fields, (B, N, D), of fields (B, N, D) of any precision."""
        modes, factors = self.modes.to(field.dtype), self.factors.to(field.dtype)
        with full_precision(field.device.type):  # rounding errors would be amplified
            coordinates = field.flatten(1) @ modes.T
            amplified = (coordinates * (factors - factors[-1])) @ modes
        return factors[-1] * field + amplified.view_as(field)

"""Whitening: inputs of networks whose rare parts are not drowned by the frequent ones."""

from torch import Tensor

from dpl.fem.rom.pod import pod
from dpl.models.precision import full_precision

MODES = 128  # of a field that are whitened


def root_mean_square(columns: Tensor) -> Tensor:
    """Return the root mean square of each column of (S, n), (n,)."""
    return columns.square().mean(dim=0).sqrt()


def partial_whitening(size: Tensor) -> Tensor:
    """Return divisors (n,) of coordinates with root mean squares `size` (n,).

    The divisor of a coordinate is size^0.6 times the largest size^0.4, so that small coordinates
    are amplified less than by whitening, and rounding errors at most by 1000.
    """
    largest = size.max().clamp(min=1e-30)
    return (size**0.6 * largest**0.4).clamp(min=1e-3 * float(largest))


class FieldWhitening:
    """Linear map of nodal fields that divides their POD coordinates by `partial_whitening`.

    A few bending modes dominate displacements. Gradient descent learns the influence of the other
    modes as much later as their coordinates are smaller; divided by their sizes all are learnt
    together. The part of a field outside the modes is divided like the last of them, so that the
    map is invertible.

    Source: LeCun, Bottou, Orr, Mueller (1998), Efficient BackProp, section 4.3 (decorrelated inputs
    of equal variance).
    """

    def __init__(self, fields: Tensor, free: Tensor) -> None:
        """Compute the modes of fields.

        Args:
            fields: Fields, (S, N, D).
            free: Degrees of freedom on which they count, (N, D).
        """
        columns = fields[:, free].double()
        vectors = pod(columns, min(MODES, *columns.shape)).vectors
        size = root_mean_square(columns @ vectors)
        kept = size > 1e-6 * size.max()
        vectors, size = vectors[:, kept], size[kept]
        factors = 1 / partial_whitening(size)
        outside = (columns - columns @ vectors @ vectors.T) * factors[-1]
        square = (factors * size).square().sum() + outside.square().sum(dim=1).mean()
        factors = factors / (square / len(vectors)).sqrt()  # the mean square of a result is one
        modes = vectors.new_zeros(len(factors), free.numel())
        modes[:, free.flatten()] = vectors.T
        self._on_device = {modes.device: (modes.float(), factors.float())}

    def __call__(self, field: Tensor) -> Tensor:
        """Return whitened fields, (B, N, D), of fields (B, N, D) of any precision."""
        if field.device not in self._on_device:
            modes, factors = next(iter(self._on_device.values()))
            self._on_device[field.device] = modes.to(field.device), factors.to(field.device)
        modes, factors = (part.to(field.dtype) for part in self._on_device[field.device])
        with full_precision(field.device.type):  # rounding errors would be amplified
            coordinates = field.flatten(1) @ modes.T
            amplified = (coordinates * (factors - factors[-1])) @ modes
        return factors[-1] * field + amplified.view_as(field)

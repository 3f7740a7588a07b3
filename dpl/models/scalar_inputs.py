"""Numbers of a load as inputs of networks: its parameters and the amplitude."""

from collections.abc import Mapping

import torch
from torch import Tensor

from dpl.fem.ranges import ParameterRange
from dpl.models.linear_base import check_base
from dpl.scene import Scene


class ScalarInputs:
    """Numbers of a load, of order one, that are inputs of a network beside its nodal field.

    Attributes:
        names: Names of the columns of `Surrogate` that are needed, for `extra_inputs`.
        count: Number of the inputs.
    """

    def __init__(self, scene: Scene, base: str) -> None:
        """Take the scene with its ranges, and the base, see `LinearBase`.

        Raises:
            ValueError: There is no such base.
        """
        check_base(base)
        self.ranges = scene.loads.parameter_ranges
        amplitude = ("amplitude",) if base == "linear" else ()
        self.names = (*amplitude, *(("parameters",) if self.ranges else ()))
        self.count = len(amplitude) + len(self.ranges)

    def __call__(
        self, like: Tensor, amplitude: Tensor | None = None, parameters: Tensor | None = None
    ) -> Tensor:
        """Return the inputs, (B, count); there must be some.

        Args:
            like: Tensor (B, ...) of the dtype and device to return.
            amplitude: Amplitudes of the linear solutions, (B,); required with a linear base.
            parameters: Values of `Problem.parameter_ranges`, (B, P); required if there are any.

        Raises:
            ValueError: A required input is None.
        """
        columns = []
        if "amplitude" in self.names:
            if amplitude is None:
                raise ValueError("amplitude is an input of this network; give amplitudes, (B,)")
            columns.append((2 * amplitude / (1 + amplitude) - 1).to(like)[:, None])
        if self.ranges:
            columns.append(normalise_parameters(parameters, self.ranges, like))
        return torch.cat(columns, dim=1)


def normalise_parameters(
    parameters: Tensor | None, ranges: Mapping[str, ParameterRange], like: Tensor
) -> Tensor:
    """Return parameters mapped from their ranges to [-1, 1], (B, P).

    Args:
        parameters: Values of `Problem.parameter_ranges`, (B, P).
        ranges: Range of each, by name.
        like: Tensor of the dtype and device to return.

    Raises:
        ValueError: `parameters` is None.
    """
    if parameters is None:
        raise ValueError(f"parameters are an input of this network; give {list(ranges)}, (B, P)")
    pairs = zip(ranges.values(), parameters.unbind(1), strict=True)
    return torch.stack([ends.normalise(column) for ends, column in pairs], dim=1).to(like)

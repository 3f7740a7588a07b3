"""Parameters of the law as inputs of networks."""

from collections.abc import Mapping

from torch import Tensor


def normalise_parameters(
    parameters: Tensor | None, ranges: Mapping[str, tuple[float, float]], like: Tensor
) -> Tensor:
    """Return parameters of the law mapped linearly from their ranges to [-1, 1], (B, P).

    Args:
        parameters: Parameters of the law, (B, P).
        ranges: Range of each, by name.
        like: Tensor of the dtype and device to return.

    Raises:
        ValueError: `parameters` is None.
    """
    if parameters is None:
        raise ValueError(f"parameters are an input of this network; give {list(ranges)}, (B, P)")
    low, high = parameters.new_tensor(list(ranges.values())).T
    return ((2 * parameters - (low + high)) / (high - low)).to(like)

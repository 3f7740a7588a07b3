"""Checks of the buffers that a model takes from a file, before compiled loops read them."""

from typing import Any

from torch import Tensor, nn


class StoredBuffers(nn.Module):
    """Module that checks the values of its buffers after it has loaded them."""

    def check_buffers(self) -> None:
        """Raise ValueError if buffers do not fit together."""
        raise NotImplementedError

    def _load_from_state_dict(self, *arguments: Any) -> None:
        super()._load_from_state_dict(*arguments)
        self.check_buffers()


def check_indices(count: int, **indices: Tensor) -> None:
    """Raise ValueError if an index, of the tensor that the keyword names, is not in [0, count)."""
    for name, values in indices.items():
        if wrong := values[(values < 0) | (values >= count)].tolist():
            raise ValueError(f"{name} contains {wrong[0]}; it must lie between 0 and {count - 1}")

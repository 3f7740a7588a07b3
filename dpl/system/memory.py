"""Checks of required memory before anything is allocated."""

import contextlib
import os
from collections.abc import Iterator
from contextvars import ContextVar

NODE_SIZE = 1000  # lower bound of the memory of a node with its row of K(0), in 2D [bytes]
_MOST: ContextVar[tuple[int, str] | None] = ContextVar("most nodes of a mesh", default=None)


def refuse_beyond(needed: float, limit: float | None, what: str, remedy: str) -> None:
    """Raise MemoryError if objects need more memory [GB] than a limit.

    The limit None is the memory of the GPU, or of the machine if it has no GPU.
    """
    if limit is None:
        import torch  # not needed by those who read meshes

        limit = torch.cuda.mem_get_info()[1] / 1e9 if torch.cuda.is_available() else machine()
    if needed > limit:
        raise MemoryError(f"{what} need {needed:,.1f} GB, there are {limit:.1f} GB; {remedy}")


def machine() -> float:
    """Return the memory of the machine [GB]."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9


@contextlib.contextmanager
def at_most(nodes: int, reason: str) -> Iterator[None]:
    """Make `refuse_mesh` refuse meshes with more nodes, with this reason in its message."""
    token = _MOST.set((nodes, reason))
    try:
        yield
    finally:
        _MOST.reset(token)


def refuse_mesh(nodes: int, key: str) -> None:
    """Raise an error if K(0) of a mesh exceeds the memory, or its nodes those of `at_most`."""
    most, reason = _MOST.get() or (nodes, "")
    if nodes > most:
        raise ValueError(f"{key} = {nodes:,} nodes must be {most:,} at most; {reason}")
    refuse_beyond(nodes * NODE_SIZE / 1e9, machine(), f"{nodes:,} nodes", f"take fewer {key}")


def refuse_weights(parameters: int, limit: float | None, remedy: str) -> None:
    """Raise MemoryError if training this many float32 parameters exceeds the memory."""
    needed = parameters * 4 * 4 / 1e9  # parameters, gradients, two moments, 4 bytes each
    what = f"{parameters:,} parameters with gradients and Adam's moments"
    refuse_beyond(needed, limit, what, remedy)

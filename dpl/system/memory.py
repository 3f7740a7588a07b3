"""What does not fit into memory is refused before it is made."""

import contextlib
import os
from collections.abc import Iterator
from contextvars import ContextVar

import torch

NODE = 1000  # of a node with its row of K(0), in 2D, where it is least [bytes]
_MOST: ContextVar[tuple[int, str] | None] = ContextVar("most nodes of a mesh", default=None)


def refuse_beyond(needed: float, limit: float | None, what: str, remedy: str) -> None:
    """Raise where memory does not do.

    Args:
        needed: [GB].
        limit: What there is [GB]; None: what the GPU has, or the machine where it has none.
        what: Needs it, in the plural.
        remedy: What to do about it.

    Raises:
        MemoryError: More is needed than there is.
    """
    if limit is None:
        limit = torch.cuda.mem_get_info()[1] / 1e9 if torch.cuda.is_available() else machine()
    if needed > limit:
        raise MemoryError(f"{what} need {needed:,.1f} GB, there are {limit:.1f} GB; {remedy}")


def machine() -> float:
    """Return the memory of the machine [GB]."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9


@contextlib.contextmanager
def at_most(nodes: int, reason: str) -> Iterator[None]:
    """Let `refuse_mesh` refuse meshes of more nodes, before they are made, and say why."""
    token = _MOST.set((nodes, reason))
    try:
        yield
    finally:
        _MOST.reset(token)


def refuse_mesh(nodes: int, key: str) -> None:
    """Raise where not even the stiffness matrix of so many nodes would fit, see `refuse_beyond`.

    Raises:
        ValueError: They are more than `at_most` allows.
    """
    most, reason = _MOST.get() or (nodes, "")
    if nodes > most:
        raise ValueError(f"{key} = {_count(nodes)} nodes must be {_count(most)} at most; {reason}")
    refuse_beyond(nodes * NODE / 1e9, machine(), f"{_count(nodes)} nodes", f"take fewer {key}")


def refuse_weights(parameters: int, limit: float | None, remedy: str) -> None:
    """Raise where training so many parameters in float32 would not fit, see `refuse_beyond`."""
    needed = parameters * 4 * 4 / 1e9  # parameters, gradients, two moments, 4 bytes each
    what = f"{_count(parameters)} parameters with gradients and Adam's moments"
    refuse_beyond(needed, limit, what, remedy)


def _count(number: int) -> str:
    return f"{number:,}" if number < 10**15 else f"{number:.1e}"

"""What does not fit into memory is refused before it is made."""

import os

import torch


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
        if torch.cuda.is_available():
            limit = torch.cuda.mem_get_info()[1] / 1e9
        else:
            limit = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    if needed > limit:
        raise MemoryError(f"{what} need {needed:.1f} GB, there are {limit:.1f} GB; {remedy}")

"""Threads of PyTorch and of the BLAS libraries."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch
from threadpoolctl import ThreadpoolController


@cache
def blas() -> ThreadpoolController:
    """The BLAS libraries of this process; to find them takes milliseconds, to limit them none."""
    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep torch and BLAS to one thread; for more, use processes.

    Inside one solve two threads are slower than one, and far slower where the other core is busy.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with blas().limit(limits=1):
            yield
    finally:
        torch.set_num_threads(before)

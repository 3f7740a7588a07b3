"""Threads of PyTorch and of the BLAS libraries."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import TypeVar

import torch
from threadpoolctl import ThreadpoolController

S = TypeVar("S")
T = TypeVar("T")


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def leave_cores(workers: int) -> None:
    """Limit torch to the cores that worker processes leave, at least one.

    Threads of one operation wait for each other, so none may share a core with a worker.
    """
    left = max(1, available_cores() - workers)
    torch.set_num_threads(min(torch.get_num_threads(), left))


@cache
def blas() -> ThreadpoolController:
    """Return a controller of the BLAS libraries of this process; the search takes milliseconds."""
    return ThreadpoolController().select(user_api="blas")


@contextmanager
def limited_threads(count: int) -> Iterator[None]:
    """Let torch and BLAS use `count` threads."""
    pools = [(pool, pool.get_num_threads()) for pool in (torch, *blas().lib_controllers)]
    changed = [(pool, before) for pool, before in pools if before != count]
    for pool, _ in changed:
        pool.set_num_threads(count)
    try:
        yield
    finally:
        for pool, before in changed:
            pool.set_num_threads(before)


def one_thread() -> AbstractContextManager[None]:
    """Limit torch and BLAS to one thread.

    Within one solve, two threads are slower than one, and much slower if the other core is busy.
    Parallel solves therefore use processes.
    """
    return limited_threads(1)


def on_threads(call: Callable[[S], T], items: Sequence[S]) -> list[T]:
    """Return the results of a call for each item, on as many threads as torch uses.

    The threads run in parallel only where the call releases the interpreter lock, as compiled loops
    with `nogil` do.
    """
    count = min(torch.get_num_threads(), len(items))
    if count < 2:
        return [call(item) for item in items]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(call, items))

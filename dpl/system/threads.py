"""Threads of PyTorch and of the BLAS libraries."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from pathlib import Path
from typing import TypeVar

import torch
from threadpoolctl import ThreadpoolController, threadpool_info

# OpenBLAS kernels by flag of the CPU, best first
KERNELS = {"avx512dq": "SkylakeX", "avx2": "Haswell"}
CPUINFO = Path("/proc/cpuinfo")
# kernels that OpenBLAS selects for CPUs that it does not know
OLD_KERNELS = {"generic", "prescott", "core2", "penryn", "dunnington", "atom", "nehalem"}
FEWEST = 16  # items for which a thread starts; on a busy machine its start takes milliseconds
S = TypeVar("S")
T = TypeVar("T")


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


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


def on_threads(call: Callable[[S], T], items: Sequence[S], threads: int | None = None) -> list[T]:
    """Return the results of a call for each item, on as many threads as torch uses.

    Each thread has `FEWEST` items or more, unless `threads` states their number. The threads run in
    parallel only where the call releases the interpreter lock, as compiled loops with `nogil` and
    BLAS do.
    """
    count = min(torch.get_num_threads(), len(items) // FEWEST) if threads is None else threads
    if count < 2:
        return [call(item) for item in items]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(call, items))


def slow_blas() -> str | None:
    """Return a line of advice if OpenBLAS does not recognise this CPU, else None."""
    if "OPENBLAS_CORETYPE" in os.environ or not CPUINFO.exists():
        return None
    lines = CPUINFO.read_text().splitlines()
    flags = next((line.split() for line in lines if line.startswith("flags")), [])
    best = next((kernels for flag, kernels in KERNELS.items() if flag in flags), None)
    for library in threadpool_info():
        kernels = str(library.get("architecture", ""))
        if library["internal_api"] == "openblas" and best and kernels.lower() in OLD_KERNELS:
            return (
                f"OpenBLAS runs its {kernels} kernels on a CPU with newer instructions: "
                f"set OPENBLAS_CORETYPE={best} before Python starts"
            )
    return None
